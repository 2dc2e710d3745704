"""Segmenting: whatever the network, its label maps are those of the painted world."""

import subprocess
import sys
import types

import numpy as np
import onnx
import pytest
import torch
from drawings import SIGN, SKY, SPACE
from helpers import flip_byte, street
from kornia.enhance import Denormalize, Normalize
from kornia.geometry import Resize
from networks import (
    CLASSES,
    PLAIN,
    Strided,
    Then,
    colour_network,
    photo,
    write_graph,
    write_published,
    write_segformer,
)
from PIL import Image
from torch import nn

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import encode_to_memory
from ssrvlad_torch.onnx_files import external_files
from ssrvlad_torch.segmentation import segmenter as segmentation
from ssrvlad_torch.segmentation.network_outputs import classes_of, enlarged
from ssrvlad_torch.segmentation.networks import open_network
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.preparation import Preparation, SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter

LABELS = [street(seed) for seed in range(5)]
PHOTOS = [photo(labels) for labels in LABELS]
NOISE = np.random.default_rng(0).integers(0, 256, (17, 23, 3), np.uint8)
BYTES = SegmenterConfig(white=255, mean=(0, 0, 0), std=(1, 1, 1))


def assert_right(segmenter, photos=PHOTOS, expected=LABELS):
    for labels, right in zip(segmenter(photos), expected, strict=True):
        np.testing.assert_array_equal(labels, right)
        assert labels.dtype == np.uint8


def write_image(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write_photos(folder, seeds=range(5), size=(24, 32)):
    for seed in seeds:
        write_image(folder / f"{seed}.png", photo(street(seed, *size)))
    return folder


def counted(network):
    """Counts the images that a network is given, in ``network.images``."""
    network.images = torch.zeros((), dtype=torch.int64)

    def count(module, arguments):
        module.images += len(arguments[0])

    network.register_forward_pre_hook(count)
    return network


# ---- what a network gives


OUTPUTS = {
    "tensor": lambda scores: scores,
    "torchvision": lambda scores: {"out": scores, "aux": -scores},
    "one of a mapping": lambda scores: {"features": scores[:, :5], "segmentation": scores},
    "transformers": lambda scores: types.SimpleNamespace(loss=None, logits=scores),
    "tuple": lambda scores: (scores, scores.mean((2, 3))),
    "half": lambda scores: scores.half(),
    "channels last": lambda scores: scores.permute(0, 2, 3, 1),
    "ids": lambda scores: scores.argmax(1),
    "ids with an axis": lambda scores: scores.argmax(1, keepdim=True),
    "ids with an axis at the end": lambda scores: scores.argmax(1)[..., None],
    "ids in 16 bits": lambda scores: scores.argmax(1).to(torch.uint16),
}


@pytest.mark.parametrize("form", OUTPUTS)
def test_an_output_is_recognised_by_its_shape(form):
    assert_right(Segmenter(Then(OUTPUTS[form]), SPACE, PLAIN))


@pytest.mark.parametrize(
    ("give", "message"),
    [
        (
            lambda scores: scores[:, :7],
            r"no output fits label space camvid-11: got output \(1, 7, 24, 32\) float32; "
            r"expected \(B, C, h, w\) class scores, C = 11 or 12, or \(B, h, w\) integer ids$",
        ),
        (lambda scores: torch.cat([scores, scores], 1), r"; --classes 0:12 takes the first 12"),
        (lambda scores: scores[:, 0] > 0, r"got output \(1, 24, 32\) bool"),
        (lambda scores: scores.long(), r"got output \(1, 12, 24, 32\) int64"),
        (lambda scores: {"a": scores, "b": scores}, r"several .*: a \(1, 12.*, b \(1, 12"),
        (lambda scores: scores.repeat(2, 1, 1, 1), "gives 2 outputs for 1 images"),
        (lambda scores: None, "gives a NoneType without tensors"),
    ],
)
def test_an_output_that_cannot_be_recognised_is_an_error_that_has_it(give, message):
    with pytest.raises(ValueError, match=message) as error:
        Segmenter(Then(give), SPACE, PLAIN)(PHOTOS[:1])
    assert "\n" not in str(error.value)


def test_the_output_and_the_channels_may_be_named():
    def give(scores):
        return {"one": torch.cat([scores[:, :3] + 9, scores], 1), "other": -scores}

    config = SegmenterConfig(**{**vars(PLAIN), "output": "one", "classes": (3, 15)})
    assert_right(Segmenter(Then(give), SPACE, config))
    with pytest.raises(ValueError, match=r"no output 'out'; the outputs are one \(1, 15, 24"):
        Segmenter(Then(give), SPACE, SegmenterConfig(output="out"))(PHOTOS[:1])


@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("size", [None, (16, 40), 40])
def test_the_class_is_decided_at_the_stride_of_the_scores(stride, size):
    network = Strided(stride)
    config = SegmenterConfig(size=size)
    (labels,) = Segmenter(network, SPACE, config)([NOISE])
    scores = network(Preparation(config)(torch.from_numpy(NOISE)[None]))[0]
    best = scores.detach().numpy().argmax(0)
    rows, columns = (
        [int((i + 0.5) * cells / pixels) for i in range(pixels)]
        for cells, pixels in zip(best.shape, (17, 23), strict=True)
    )
    np.testing.assert_array_equal(labels, best[np.ix_(rows, columns)])


def test_the_first_of_equal_scores_wins_and_minus_infinity_never():
    assert not classes_of(torch.zeros(1, CLASSES, 4, 4)).any()
    masked = torch.full((1, CLASSES, 6, 8), -torch.inf)
    masked[:, 5] = -3
    assert (enlarged(classes_of(masked), 9, 5) == 5).all()


@pytest.mark.parametrize(
    ("ids", "dtype"), [(255, "uint8"), (256, "uint16"), (-1, "int64"), (1 << 40, "int64")]
)
def test_large_and_negative_ids_are_kept(ids, dtype):
    network = Then(lambda scores: torch.full_like(scores[:, 0, ::2, ::2], 0).long() + ids)
    (labels,) = Segmenter(network, "cityscapes-trainids", PLAIN)(PHOTOS[:1])
    assert labels.dtype == dtype
    assert (labels == ids).all()


def test_nan_scores_are_skipped_for_the_image_that_has_them(tmp_path):
    def spoil(scores):
        scores[1, 4, 2:4, 7] = torch.nan
        return scores

    files = find_image_files([str(write_photos(tmp_path / "a"))])
    results = [labels for _, labels in Segmenter(Then(spoil), SPACE, PLAIN).label_maps(files)]
    assert [isinstance(each, ValueError) for each in results] == [False, True, False, False, False]
    assert "hold 2 NaN values" in str(results[1])


# ---- what a network is given


def test_colours_are_normalised_as_the_settings_say():
    pixels = torch.tensor([[[[255, 0, 51], [0, 102, 255]]]], dtype=torch.uint8)
    rgb = Preparation(SegmenterConfig(mean=(0.5, 0.25, 0), std=(0.5, 0.25, 2)))(pixels)
    bgr = Preparation(
        SegmenterConfig(white=255, mean=(104, 117, 123), std=(1, 1, 2), colour_order="bgr")
    )(pixels)
    np.testing.assert_allclose(rgb[0], [[[1, -1]], [[-1, 0.6]], [[0.1, 0.5]]], atol=1e-6)
    np.testing.assert_allclose(bgr[0], [[[-53, 151]], [[-117, -15]], [[66, -61.5]]], atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({}, (90, 160)),
        ({"multiple": 16}, (96, 160)),
        ({"size": (50, 70), "multiple": 32}, (50, 70)),
        ({"size": 45}, (45, 80)),
        ({"size": 180, "longest": 240}, (135, 240)),
        ({"size": 45, "multiple": 32}, (32, 96)),
    ],
)
def test_sizes(settings, size):
    config = SegmenterConfig(**settings)
    assert config.network_size(90, 160) == size
    if not isinstance(config.size, tuple):
        assert config.network_size(160, 90) == size[::-1]
    assert Preparation(config)(torch.zeros(1, 90, 160, 3)).shape == (1, 3, *size)


def test_resizing_is_that_of_pillow_but_for_its_rounding():
    for size in ((8, 11), (40, 31)):
        config = SegmenterConfig(size=size, mean=(0, 0, 0), std=(1, 1, 1), white=255)
        found = Preparation(config)(torch.from_numpy(NOISE)[None])[0].permute(1, 2, 0)
        expected = Image.fromarray(NOISE).resize(size[::-1], Image.Resampling.BILINEAR)
        assert np.abs(found.numpy() - np.asarray(expected)).max() < 1.01


def test_images_of_like_size_share_a_batch_of_bounded_pixels(monkeypatch):
    sizes = [(24, 32), (24, 32), (30, 20), (24, 32), (24, 32), (30, 20), (24, 32)]
    labels = [street(seed, *size) for seed, size in enumerate(sizes)]
    batches = []
    network = colour_network()
    network.register_forward_pre_hook(lambda module, given: batches.append(given[0].shape))
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 2 * 24 * 32)
    assert_right(Segmenter(network, SPACE, PLAIN), [photo(one) for one in labels], labels)
    assert sorted(batches) == [(1, 3, 24, 32), (2, 3, 24, 32), (2, 3, 24, 32), (2, 3, 30, 20)]


def test_the_network_is_in_evaluation_mode_and_takes_no_gradients():
    network = nn.Sequential(colour_network(), nn.Dropout(0.9))
    network[0].weight.requires_grad_(True)
    assert_right(Segmenter(network.train(), SPACE, PLAIN))
    assert not network.training


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_the_network_runs_where_its_weights_lie():
    assert_right(Segmenter(colour_network().cuda(), SPACE, PLAIN))


def test_what_fails_in_a_batch_is_tried_alone_and_named(tmp_path):
    class Picky(nn.Module):
        def __init__(self):
            super().__init__()
            self.network = colour_network()

        def forward(self, images):
            if len(images) > 1 or images.shape[2] % 8:
                raise torch.OutOfMemoryError("one at a time,\nmultiples of 8")
            return self.network(images)

    write_photos(tmp_path / "a", [0, 2])
    write_photos(tmp_path / "a", [1], size=(25, 32))
    files = find_image_files([str(tmp_path / "a")])
    results = [result for _, result in Segmenter(Picky(), SPACE, PLAIN).label_maps(files)]
    np.testing.assert_array_equal(results[0], LABELS[0])
    np.testing.assert_array_equal(results[2], LABELS[2])
    assert str(results[1]) == "the network fails at 25x32: one at a time, multiples of 8"


def test_a_long_picture_is_not_resized_to_any_size():
    segmenter = Segmenter(colour_network(), SPACE, SegmenterConfig(size=2000))
    with pytest.raises(ValueError, match="at 1x40: has 2000 x 80000 pixels; expected at most"):
        segmenter([NOISE[:1].repeat(2, 1)[:, :40]])


@pytest.mark.parametrize("image", [NOISE / 255, NOISE[..., 0], NOISE[:0], NOISE.astype(int)])
def test_what_is_no_image_is_an_error(image):
    with pytest.raises(ValueError, match=r"expected \(H, W, 3\) uint8 images, got"):
        Segmenter(colour_network(), SPACE)([image])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": (0, 5)}, r"size must be height and width .* got \(0, 5\)"),
        ({"size": (5, 5.0)}, "size must be"),
        ({"longest": 0}, "longest must be"),
        ({"multiple": 1.5}, "multiple must be"),
        ({"white": 0}, "white must be a number above 0, got 0"),
        ({"mean": (0, 0, float("nan"))}, "mean must be three numbers"),
        ({"std": (1, True, 1)}, "std must be three numbers above 0"),
        ({"colour_order": "RGB"}, "colour_order must be rgb or bgr, got 'RGB'"),
        ({"output": 0}, "output must be a name, got 0"),
        ({"classes": (3, 3)}, "classes must be FIRST:LAST"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        SegmenterConfig(**settings)


# ---- ONNX graphs


GRAPHS = {
    "dynamic": {},
    "all fixed": {"shape": (1, 3, 24, 32)},
    "a batch of three": {"shape": (3, 3, 24, 32)},
    "channels free": {"shape": ("b", "c", "h", "w")},
    "labels inside": {"labels": True},
    "external weights": {"external": True},
    "double input": {"dtype": "double"},
    "channels last": {"shape": ("b", "h", "w", 3), "channels_last": True},
    "channels last, labels inside": {
        "shape": (1, 24, 32, 3),
        "channels_last": True,
        "labels": True,
    },
}


@pytest.mark.parametrize("form", GRAPHS)
def test_a_graph_gives_what_the_network_gives(tmp_path, form):
    path = write_graph(tmp_path / "net.onnx", **GRAPHS[form])
    assert_right(Segmenter(OnnxNetwork(path), SPACE, PLAIN))


def test_a_graph_that_takes_bytes(tmp_path):
    shape = (1, 24, 32, 3)
    path = write_graph(tmp_path / "net.onnx", shape, "bytes", channels_last=True, white=255)
    assert_right(Segmenter(OnnxNetwork(path), SPACE, BYTES))
    with pytest.raises(ValueError, match=r"net\.onnx: takes bytes: expected white 255, got 1"):
        Segmenter(OnnxNetwork(path), SPACE)


def test_classes_that_are_as_many_as_columns_are_told_apart(tmp_path):
    """(1, 12, 16, 12) is read by the layout of the input."""
    labels = [street(seed, 12, 16) for seed in range(2)]
    path = write_graph(tmp_path / "net.onnx", (1, 12, 16, 3), channels_last=True)
    segmenter = Segmenter(OnnxNetwork(path), SPACE, PLAIN)
    assert_right(segmenter, [photo(one) for one in labels], labels)


def test_a_fixed_size_is_the_size_of_the_settings(tmp_path):
    path = write_graph(tmp_path / "net.onnx", (1, 3, 24, 32))
    segmenter = Segmenter(OnnxNetwork(path), SPACE)
    assert segmenter.config.size == (24, 32)
    assert segmenter([photo(street(0, 50, 70))])[0].shape == (50, 70)
    with pytest.raises(ValueError, match="takes images of 24x32, the settings say 32x32"):
        Segmenter(OnnxNetwork(path), SPACE, SegmenterConfig(size=(32, 32)))
    path = write_graph(tmp_path / "net.onnx", (1, 3, 24, "w"))
    with pytest.raises(ValueError, match="takes images of 24xany; expected a size"):
        Segmenter(OnnxNetwork(path), SPACE)


def test_an_ambiguous_graph_names_its_candidates(tmp_path):
    path = write_graph(tmp_path / "net.onnx", aux=True)
    expected = r"net\.onnx: several outputs could be labels: found \(\?, 12, \?, \?\) tensor"
    with pytest.raises(ValueError, match=expected):
        Segmenter(OnnxNetwork(path), SPACE)
    with pytest.raises(ValueError, match=r"no output fits .*cityscapes-trainids.* = 19"):
        Segmenter(OnnxNetwork(path), "cityscapes-trainids")


def graph_of(inputs, path):
    """A graph that only passes on its inputs."""
    nodes = [onnx.helper.make_node("Identity", [one.name], [f"{one.name}2"]) for one in inputs]
    outputs = [
        onnx.helper.make_tensor_value_info(f"{one.name}2", one.type.tensor_type.elem_type, None)
        for one in inputs
    ]
    graph = onnx.helper.make_graph(nodes, "none", inputs, outputs)
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    return path


def value(name, shape, dtype=onnx.TensorProto.FLOAT):
    return onnx.helper.make_tensor_value_info(name, dtype, shape)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ([value("a", [1, 3, 4, 4]), value("b", [1])], "has inputs a, b; expected one"),
        ([value("a", [1, 3, 4])], r"takes \(1, 3, 4\) tensor\(float\); expected \(B, 3, H, W\)"),
        ([value("a", [1, 1, 4, 4])], r"takes \(1, 1, 4, 4\) .*; expected images of 3 channels"),
        ([value("a", [1, 3, 4, 4], onnx.TensorProto.INT64)], r"tensor\(int64\); expected"),
    ],
)
def test_a_graph_that_takes_no_image(tmp_path, inputs, message):
    with pytest.raises(ValueError, match=message):
        OnnxNetwork(graph_of(inputs, tmp_path / "net.onnx"))


@pytest.mark.parametrize("damage", ["text", "truncated", "weights gone", "missing"])
def test_a_damaged_graph_is_an_error_in_one_line(tmp_path, damage, capfd):
    path = write_graph(tmp_path / "net.onnx", external=damage == "weights gone")
    whole = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "weights gone":
        (tmp_path / "net.data").unlink()
    else:
        path.write_bytes({"text": b"hello", "truncated": whole[:-40]}[damage])
    with pytest.raises(ValueError, match=r"net\.onnx (does not exist|cannot run)") as error:
        OnnxNetwork(path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", ""), "the runtime keeps its log to itself"


def test_a_missing_extra_is_named(tmp_path):
    path = write_graph(tmp_path / "net.onnx")
    code = (
        "import sys; sys.modules['onnxruntime'] = None\n"
        "from ssrvlad_torch import Segmenter\n"
        f"Segmenter.load({str(path)!r}, {SPACE!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install ssrvlad-torch[onnx]" in done.stderr


# ---- networks by name


def test_a_settings_file_names_a_network_beside_it(tmp_path, monkeypatch):
    (tmp_path / "nets").mkdir()
    write_graph(tmp_path / "nets" / "net.onnx", aux=True)
    (tmp_path / "nets" / "net.yaml").write_text(
        "network: net.onnx\nsize: [24, 32]\nmean: [0, 0, 0]\nstd: [1, 1, 1]\noutput: found\n"
        f"classes: 0:12\nlabels_as: {SPACE}\n"
    )
    monkeypatch.chdir(tmp_path)
    segmenter = Segmenter.load("nets/net.yaml")
    assert segmenter.config == SegmenterConfig(
        size=(24, 32), mean=(0, 0, 0), std=(1, 1, 1), output="found", classes=(0, 12)
    )
    assert_right(segmenter)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"cannot read the settings .*net\.yaml: No such file"),
        ("network: [", r"^\S*net\.yaml is no plain YAML: while parsing"),
        ("size: [4, 4]", r"net\.yaml names no network; expected network: NAME"),
        ("network: net.onnx\nmeans: 3", r"unknown setting 'means'; expected network, labels_as"),
        ("network: net.onnx\nmean: 3", r"net\.yaml: mean must be three numbers, got 3"),
        ("network: net.onnx\nclasses: 3-4", r"classes must be FIRST:LAST"),
        ("network: none.onnx", r"none\.onnx does not exist"),
        ("network: none", r"no network 'none'; expected FILE.onnx"),
    ],
)
def test_a_bad_settings_file_is_an_error_in_one_line(tmp_path, text, message):
    if text is not None:
        (tmp_path / "net.yaml").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        Segmenter.load(tmp_path / "net.yaml", SPACE)
    assert "\n" not in str(error.value)


def test_functions_that_make_a_network(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mynets.py").write_text("from networks import colour_network as mine\n")
    (tmp_path / "hubconf.py").write_text("from networks import Strided as strided\n")
    (tmp_path / "net.yaml").write_text(
        f"network: torchhub:{tmp_path}/strided\narguments: {{stride: 1}}\n"
        "mean: [0, 0, 0]\nstd: [1, 1, 1]\n"
    )
    assert_right(Segmenter(open_network("mynets:mine").network, SPACE, PLAIN))
    assert_right(Segmenter.load("net.yaml", SPACE))
    with pytest.raises(ValueError, match="does not say what its classes are; give --labels-as"):
        Segmenter.load("mynets:mine")
    for name in ("mynets:none", "nothing:mine", "torchhub:strided"):
        with pytest.raises(ValueError, match=name):
            open_network(name)
    with pytest.raises(ValueError, match="gives a list; expected an nn"):
        open_network("builtins:list")


@pytest.fixture(scope="module")
def hub_folder(tmp_path_factory):
    """A tiny SegFormer with random weights, as transformers saves it."""
    return write_segformer(tmp_path_factory.mktemp("hub") / "tiny")


def test_a_published_model_comes_with_its_own_settings_and_class_names(hub_folder):
    from transformers import AutoImageProcessor

    segmenter = Segmenter.load(f"hf:{hub_folder}")
    assert segmenter.config == SegmenterConfig(size=(64, 96))
    kinds = [label.category for label in segmenter.label_space.classes]
    assert kinds == [
        "ground",
        "sidewalk",
        "building",
        "pole",
        "vegetation",
        "sky",
        "dynamic",
        "void",
    ]
    processor = AutoImageProcessor.from_pretrained(hub_folder, backend="pil")
    theirs = processor(PHOTOS[0], return_tensors="pt")["pixel_values"]
    ours = segmenter.labels.preparation(torch.from_numpy(PHOTOS[0])[None])
    assert (ours - theirs).abs().max() < 1.01 / 255 / 0.224, "they round to bytes"
    assert segmenter([NOISE])[0].shape == (17, 23)


@pytest.mark.parametrize(
    "family",
    [
        "Mask2Former",
        "OneFormer",
        *(pytest.param(each, marks=pytest.mark.slow) for each in ("Beit", "DPT", "UperNet")),
    ],
)
def test_published_families(family, tmp_path):
    segmenter = Segmenter.load(write_published(tmp_path / "tiny", family))
    labels = segmenter([PHOTOS[0], NOISE])
    assert [each.shape for each in labels] == [(24, 32), (17, 23)]
    assert len(segmenter.label_space.classes) == 8
    assert segmenter.config.network_size(90, 160) == {
        "Mask2Former": (64, 128), "OneFormer": (64, 113),
    }.get(family, (64, 64))  # fmt: skip


def test_a_model_that_is_not_there_is_an_error_in_one_line(tmp_path, monkeypatch, capfd):
    pytest.importorskip("transformers")
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(OSError, match=r"^hf:nobody/nothing@1 cannot be had: ") as error:
        open_network("hf:nobody/nothing@1")
    assert "\n" not in str(error.value)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="empty cannot be used: Unrecognized model"):
        open_network(tmp_path / "empty")
    assert capfd.readouterr() == ("", "")


# ---- the cache


def run(segmenter, folder):
    """Label maps of a folder by name."""
    return {file.name: labels for file, labels in segmenter.label_maps(find_image_files([folder]))}


@pytest.fixture
def photos(tmp_path):
    return str(write_photos(tmp_path / "photos"))


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "deep" / "cache"


def entries(cache):
    return sorted(cache.rglob("*.png"))


def test_a_label_map_is_made_once_and_found_by_the_content_of_the_image(photos, cache, tmp_path):
    network = counted(colour_network())
    first = run(Segmenter(network, SPACE, PLAIN, cache), photos)
    assert len(entries(cache)) == 5
    made = int(network.images)
    write_photos(tmp_path / "others", [3])
    (tmp_path / "others" / "3.png").rename(tmp_path / "others" / "300.png")
    told = []
    segmenter = Segmenter(network, SPACE, PLAIN, cache)
    network._forward_pre_hooks.clear()
    found = run(segmenter, str(tmp_path / "others"))
    np.testing.assert_array_equal(found["300"], LABELS[3])
    list(segmenter.label_maps(find_image_files([photos]), progress=told.append))
    assert int(network.images) == made
    assert sum(told) == len(first) == 5


def test_what_computes_something_else_has_another_key():
    other = colour_network()
    other.bias.data[3] += 1e-3

    def program(add):
        torch.manual_seed(add)
        return torch.jit.freeze(torch.jit.script(nn.Conv2d(3, CLASSES, 1).eval()))

    segmenters = [
        Segmenter(colour_network(), SPACE, PLAIN),
        Segmenter(other, SPACE, PLAIN),
        Segmenter(nn.Sequential(colour_network()), SPACE, PLAIN),
        Segmenter(Strided(1), SPACE, PLAIN),
        Segmenter(Strided(2), SPACE, PLAIN),
        Segmenter(Then(lambda scores: scores), SPACE, PLAIN),
        Segmenter(Then(lambda scores: -scores), SPACE, PLAIN),
        Segmenter(program(0), SPACE, PLAIN),
        Segmenter(program(1), SPACE, PLAIN),
        Segmenter(colour_network(), SPACE, SegmenterConfig()),
        Segmenter(colour_network(), SPACE, SegmenterConfig(colour_order="bgr")),
        Segmenter(colour_network(), SPACE, SegmenterConfig(classes=(0, 11))),
    ]
    assert len({segmenter.key() for segmenter in segmenters}) == len(segmenters)
    assert segmenters[0].key() == Segmenter(colour_network(), SPACE, PLAIN).key()


@pytest.mark.parametrize("external", [False, True])
def test_a_graph_is_known_by_its_file_and_its_weights(tmp_path, external):
    def key(white):
        path = write_graph(tmp_path / "net.onnx", external=external, white=white)
        return Segmenter(OnnxNetwork(path), SPACE, PLAIN).key()

    first, second, third = key(1.0), key(1.5), key(1.0)
    assert first == third != second
    assert external_files(tmp_path / "net.onnx") == [tmp_path / "net.data"] * external


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "dangling link"])
def test_a_damaged_entry_is_made_anew(photos, cache, damage):
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    run(segmenter, photos)
    entry = entries(cache)[2]
    whole = entry.read_bytes()
    if damage == "flip":
        flip_byte(entry, len(whole) // 2)
    elif damage == "dangling link":
        entry.unlink()
        entry.symlink_to("nowhere")
    else:
        entry.write_bytes({"cut": whole[:-20], "empty": b""}[damage])
    for name, labels in run(segmenter, photos).items():
        np.testing.assert_array_equal(labels, LABELS[int(name)])
    assert entry.read_bytes() == whole


def test_the_cache_is_bounded_and_keeps_what_was_used_last(photos, cache, tmp_path):
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    run(segmenter, photos)
    size = max(entry.stat().st_size for entry in entries(cache))
    first = {entry.name for entry in entries(cache)}
    kept = write_photos(tmp_path / "kept", [2])
    run(segmenter, str(kept))
    (used,) = {e.name for e in entries(cache) if e.stat().st_mtime_ns == max(
        each.stat().st_mtime_ns for each in entries(cache))}  # fmt: skip
    segmenter.cache_bytes = 4 * size
    run(segmenter, str(write_photos(tmp_path / "more", [20])))
    left = {entry.name for entry in entries(cache)}
    assert sum(entry.stat().st_size for entry in entries(cache)) <= 4 * size
    assert used in left
    assert first - left
    assert left - first, "the new one is there"


def test_wide_ids_are_kept_and_those_that_no_png_can_hold_are_made_each_time(photos, cache):
    wide = Segmenter(Then(lambda scores: scores.argmax(1) + 1000), SPACE, PLAIN, cache)
    for _ in range(2):
        np.testing.assert_array_equal(run(wide, photos)["0"], LABELS[0].astype(int) + 1000)
    negative = Segmenter(Then(lambda scores: scores.argmax(1) - 20), SPACE, PLAIN, cache)
    np.testing.assert_array_equal(run(negative, photos)["0"], LABELS[0].astype(int) - 20)
    assert len(entries(cache)) == 5


def test_ctrl_c_keeps_what_was_made(photos, cache, monkeypatch):
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    segmenter.key()
    left = iter([None, None, None])

    def interrupt(module, arguments):
        if next(left, "end") == "end":
            raise KeyboardInterrupt

    monkeypatch.setattr(segmenter, "key", lambda: "key")
    segmenter.network.register_forward_pre_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(segmenter, photos)
    assert len(entries(cache)) == 3


def test_a_cache_that_cannot_be_written_is_an_error(photos, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        run(Segmenter(colour_network(), SPACE, PLAIN, tmp_path / "file"), photos)


# ---- images into descriptors


def test_kornia_a_network_and_the_head_are_one_module():
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    whole = nn.Sequential(Resize((24, 32)), Normalize(0.5, 0.5), Denormalize(0.5, 0.5),
                          colour_network(), head)  # fmt: skip
    images = torch.from_numpy(np.stack(PHOTOS)).permute(0, 3, 1, 2) / 255
    assert torch.equal(whole(images), head(torch.from_numpy(np.stack(LABELS))))


def test_progress_moves_while_the_network_works(tmp_path):
    """A frame is told before the network sees the one that is some fifty further."""
    files = find_image_files([str(write_photos(tmp_path / "a", range(80)))])
    network, behind, done = colour_network(), [], [0]
    network.register_forward_pre_hook(
        lambda module, given: behind.append(len(behind) - sum(done)) or None
    )
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
        encode_to_memory(head, files, 1, done.append, Segmenter(network, SPACE, PLAIN))
    assert len(behind) == sum(done) == 80
    assert max(behind) <= 50


def test_images_give_the_descriptors_of_their_label_maps(tmp_path):
    """Of an image that is cut off, and one whose ids are unknown, the reason is told."""
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    for seed in range(20):
        labels = street(seed) % SIGN
        labels[2:4, 5:8] = SIGN if seed == 7 else SKY
        write_image(tmp_path / "a" / f"{seed}.png", photo(labels))
        if seed not in (4, 7):
            write_image(tmp_path / "maps" / "a" / f"{seed}.png", labels)
    cut = tmp_path / "a" / "4.png"
    cut.write_bytes(cut.read_bytes()[:60])
    network = Then(lambda scores: scores.argmax(1).masked_fill_(scores.argmax(1) == SIGN, 99))
    segmenter = Segmenter(network, SPACE, PLAIN)
    files = find_image_files([str(tmp_path / "a")])
    frames, skipped = encode_to_memory(head, files, segmenter=segmenter)
    by_maps, _ = encode_to_memory(head, find_label_files([str(tmp_path / "maps" / "a")]))
    assert frames.frames == by_maps.frames
    assert torch.equal(frames.descriptors, by_maps.descriptors)
    assert [each.frame for each in skipped] == ["a/4", "a/7"]
    assert "label id 99 (6 pixels) is not in" in skipped[1].reason
    other = Segmenter(colour_network(), "synthia", PLAIN)
    with pytest.raises(ValueError, match="gives labels of synthia, the head reads camvid-11"):
        encode_to_memory(head, files, segmenter=other)
