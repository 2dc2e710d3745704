"""Segmenting: whatever the network, its label maps are those of the painted world."""

import importlib
import multiprocessing
import os
import subprocess
import sys
import types

import numpy as np
import onnx
import pytest
import torch
from drawings import SIGN, SKY, SPACE
from helpers import flip_byte, street, write_street
from networks import CLASSES, PLAIN, Strided, Then, colour_network, photo, write_graph
from PIL import Image
from torch import nn
from torch.nn.functional import interpolate

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding import encoder as encoding
from ssrvlad_torch.encoding.encoder import encode_to_database, encode_to_memory
from ssrvlad_torch.segmentation import segmenter as segmentation
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter, SegmenterConfig

LABELS = [street(seed) for seed in range(5)]
PHOTOS = [photo(labels) for labels in LABELS]
NOISE = np.random.default_rng(0).integers(0, 256, (17, 23, 3), np.uint8)
BYTES = SegmenterConfig(white=255, mean=(0, 0, 0), std=(1, 1, 1))
HEAD = SSRVLAD.from_preset("default", labels_as=SPACE)


def assert_right(segmenter, photos=PHOTOS, wanted=LABELS):
    for labels, expected in zip(segmenter(photos), wanted, strict=True):
        np.testing.assert_array_equal(labels, expected)
        assert labels.dtype == np.uint8


def write_image(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write_photos(folder, seeds=range(5), suffix=".png", size=(24, 32)):
    for seed in seeds:
        write_image(folder / f"{seed}{suffix}", photo(street(seed, *size)))
    return folder


def counted(network):
    """Counts the images that a network is given, in ``network.images``."""
    network.images = 0

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
    "transformers, as a mapping": lambda scores: {"logits": scores, "hidden": (scores, scores)},
    "tuple": lambda scores: (scores, scores.mean((2, 3))),
    "half": lambda scores: scores.bfloat16().double().half() + scores.half(),
    "probabilities": lambda scores: scores.softmax(1),
    "channels last": lambda scores: scores.permute(0, 2, 3, 1),
    "ids": lambda scores: scores.argmax(1),
    "ids with an axis": lambda scores: scores.argmax(1, keepdim=True),
    "ids with an axis at the end": lambda scores: scores.argmax(1)[..., None],
    "ids as bytes": lambda scores: scores.argmax(1).byte(),
    "ids in 16 bits": lambda scores: scores.argmax(1).to(torch.uint16),
    "ids among features": lambda scores: {"ids": scores.argmax(1), "features": scores[:, :7]},
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
            r"wanted \(B, C, h, w\) class scores, C = 11 or 12, or \(B, h, w\) integer ids",
        ),
        (lambda scores: scores[:, 0], r"got output \(1, 24, 32\) float32"),
        (lambda scores: scores[:, 0] > 0, r"got output \(1, 24, 32\) bool"),
        (lambda scores: scores.long(), r"got output \(1, 12, 24, 32\) int64"),
        (lambda scores: scores[0], r"got output \(12, 24, 32\) float32"),
        (lambda scores: {"a": scores, "b": scores}, r"several .*: a \(1, 12.*, b \(1, 12"),
        (lambda scores: scores.repeat(2, 1, 1, 1), "gives 2 outputs for 1 images"),
        (lambda scores: None, "gives a NoneType without tensors"),
        (lambda scores: [], "gives a list without tensors"),
    ],
)
def test_an_output_that_cannot_be_recognised_is_an_error_that_has_it(give, message):
    with pytest.raises(ValueError, match=message) as refusal:
        Segmenter(Then(give), SPACE, PLAIN)(PHOTOS[:1])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("name", "right"), [("one", True), ("other", False)])
def test_the_output_may_be_named(name, right):
    network = Then(lambda scores: {"one": scores, "other": -scores})
    segmenter = Segmenter(network, SPACE, SegmenterConfig(**{**vars(PLAIN), "output": name}))
    assert (segmenter(PHOTOS[:1])[0] == LABELS[0]).all() == right


def test_a_name_that_no_output_has_is_an_error_that_lists_them():
    config = SegmenterConfig(output="out")
    with pytest.raises(ValueError, match=r"no output 'out'; the outputs are output \(1, 12, 24"):
        Segmenter(Then(OUTPUTS["tensor"]), SPACE, config)(PHOTOS[:1])


def test_void_at_the_end_may_have_no_channel():
    labels = np.minimum(LABELS[0], 10)
    assert_right(Segmenter(Then(lambda s: s[:, :11]), SPACE, PLAIN), [photo(labels)], [labels])


@pytest.mark.parametrize("stride", [1, 2, 4, 8])
@pytest.mark.parametrize("size", [None, (16, 40), (64, 64)])
def test_scores_are_enlarged_to_the_size_of_the_image(stride, size):
    """Held to one plain interpolation of all classes and an argmax."""
    network = Strided(stride)
    config = SegmenterConfig(size=size)
    (labels,) = Segmenter(network, SPACE, config)([NOISE])
    resized = NOISE
    if size:
        resized = np.asarray(Image.fromarray(NOISE).resize(size[::-1], Image.Resampling.BILINEAR))
    mean, std = torch.tensor(config.mean), torch.tensor(config.std)
    images = ((torch.from_numpy(np.array(resized)) / 255 - mean) / std).permute(2, 0, 1)[None]
    scores = interpolate(network(images), (17, 23), mode="bilinear", align_corners=False)
    np.testing.assert_array_equal(labels, scores[0].argmax(0).numpy())


def test_ids_are_enlarged_by_the_nearest_pixel():
    network = Then(lambda scores: scores.argmax(1)[:, ::2, ::2])
    labels = LABELS[0].repeat(2, axis=0).repeat(2, axis=1)
    assert_right(Segmenter(network, SPACE, PLAIN), [photo(labels)], [labels])


@pytest.mark.parametrize(
    ("ids", "dtype"), [(255, "uint8"), (256, "uint16"), (-1, "int64"), (1 << 40, "int64")]
)
@pytest.mark.parametrize("stride", [1, 2])
def test_large_and_negative_ids_are_kept(ids, dtype, stride):
    network = Then(lambda scores: torch.full_like(scores[:, 0, ::stride, ::stride], 0).long() + ids)
    (labels,) = Segmenter(network, "cityscapes-trainids", PLAIN)(PHOTOS[:1])
    assert labels.dtype == dtype
    assert (labels == ids).all()


def test_the_first_of_equal_scores_wins_and_minus_infinity_never():
    flat = Segmenter(Then(lambda scores: 0 * scores), SPACE, PLAIN)
    assert not flat([NOISE])[0].any()
    masked = torch.full((1, CLASSES, 6, 8), -torch.inf)
    masked[:, 5] = -3
    assert (Segmenter(Then(lambda scores: masked), SPACE, PLAIN)(PHOTOS[:1])[0] == 5).all()


def test_nan_scores_are_refused_for_the_image_that_has_them():
    def spoil(scores):
        scores[1, 4, 2:4, 7] = torch.nan
        return scores

    segmenter = Segmenter(Then(spoil), SPACE, PLAIN)
    with pytest.raises(ValueError, match="hold 2 NaN values"):
        segmenter(PHOTOS[:2])


# ---- what a network is given


def test_colours_are_normalised_as_the_settings_say():
    given = []

    class Watch(nn.Module):
        def forward(self, images):
            given.append(images)
            return torch.zeros(len(images), CLASSES, 2, 2)

    pixels = np.array([[[255, 0, 51], [0, 102, 255]]], np.uint8)
    for config in (
        SegmenterConfig(mean=(0.5, 0.25, 0), std=(0.5, 0.25, 2)),
        SegmenterConfig(white=255, mean=(104, 117, 123), std=(1, 1, 2), colour_order="bgr"),
    ):
        Segmenter(Watch(), SPACE, config)([pixels])
    rgb, bgr = (images[0].tolist() for images in given)
    np.testing.assert_allclose(rgb, [[[1, -1]], [[-1, 0.6]], [[0.1, 0.5]]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(bgr, [[[-53, 151]], [[-117, -15]], [[66, -61.5]]], atol=1e-4)


def test_the_defaults_are_those_of_image_net():
    given = []
    network = Then(lambda scores: scores)
    network.register_forward_pre_hook(lambda module, arguments: given.append(arguments[0]))
    Segmenter(network, SPACE)([NOISE])
    scaled = NOISE / 255
    expected = (scaled - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    np.testing.assert_allclose(given[0][0].permute(1, 2, 0), expected, atol=1e-5)


def test_images_of_like_size_share_a_batch_of_bounded_pixels(monkeypatch):
    sizes = [(24, 32), (24, 32), (30, 20), (24, 32), (24, 32), (30, 20), (24, 32)]
    labels = [street(seed, *size) for seed, size in enumerate(sizes)]
    batches = []
    network = colour_network()
    network.register_forward_pre_hook(lambda module, given: batches.append(given[0].shape))
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 2 * 24 * 32)
    assert_right(Segmenter(network, SPACE, PLAIN), [photo(one) for one in labels], labels)
    assert sorted(batches) == [(1, 3, 24, 32), (2, 3, 24, 32), (2, 3, 24, 32), (2, 3, 30, 20)]
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
    batches.clear()
    assert_right(Segmenter(network, SPACE, PLAIN), [photo(one) for one in labels], labels)
    assert len(batches) == 7


def test_images_of_any_size_share_a_batch_if_the_network_has_one():
    network = counted(nn.AdaptiveAvgPool2d((4, 4)))
    whole = nn.Sequential(network, colour_network())
    given = []
    whole.register_forward_pre_hook(lambda module, arguments: given.append(arguments[0].shape))
    photos = [photo(street(0, 30, 40)), photo(street(1, 9, 21))]
    found = Segmenter(whole, SPACE, SegmenterConfig(size=(16, 16)))(photos)
    assert [labels.shape for labels in found] == [(30, 40), (9, 21)]
    assert given == [(2, 3, 16, 16)]


def test_the_network_is_in_evaluation_mode_and_takes_no_gradients():
    network = nn.Sequential(colour_network(), nn.Dropout(0.9))
    network[0].weight.requires_grad_(True)
    assert_right(Segmenter(network.train(), SPACE, PLAIN))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_the_images_have_the_dtype_of_the_weights(dtype):
    segmenter = Segmenter(colour_network().to(dtype), SPACE, PLAIN)
    (labels,) = segmenter(PHOTOS[:1])
    assert (labels == LABELS[0]).mean() > 0.9, "colours may be nearer than a half float can tell"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_the_network_runs_where_its_weights_lie():
    assert_right(Segmenter(colour_network().cuda(), SPACE, PLAIN))


def test_a_size_that_the_network_cannot_take_is_refused_and_the_others_are_not(tmp_path):
    class Picky(nn.Module):
        def __init__(self):
            super().__init__()
            self.network = colour_network()

        def forward(self, images):
            if images.shape[2] % 8:
                raise AssertionError("wrong input shape,\nwanted multiples of 8")
            return self.network(images)

    write_photos(tmp_path / "a", [0, 2])
    write_photos(tmp_path / "a", [1], size=(25, 32))
    files = find_image_files([str(tmp_path / "a")])
    results = [result for _, result in Segmenter(Picky(), SPACE, PLAIN).label_maps(files)]
    np.testing.assert_array_equal(results[0], LABELS[0])
    np.testing.assert_array_equal(results[2], LABELS[2])
    message = "the network fails at 25x32: wrong input shape, wanted multiples of 8"
    assert str(results[1]) == message


def test_what_fails_in_a_batch_is_tried_alone():
    class Small(nn.Module):
        def __init__(self):
            super().__init__()
            self.network = colour_network()

        def forward(self, images):
            if len(images) > 1:
                raise torch.OutOfMemoryError("out of memory")
            return self.network(images)

    assert_right(Segmenter(Small(), SPACE, PLAIN))


@pytest.mark.parametrize(
    "image", [NOISE / 255, NOISE[..., 0], NOISE[..., :2], NOISE[:0], NOISE.astype(int)]
)
def test_what_is_no_image_is_refused(image):
    with pytest.raises(ValueError, match=r"wanted \(H, W, 3\) uint8 images, got"):
        Segmenter(colour_network(), SPACE)([image])


# ---- settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": (0, 5)}, r"size must be height and width in pixels, got \(0, 5\)"),
        ({"size": (5, 5.0)}, "size must be"),
        ({"size": 512}, "size must be .* got 512"),
        ({"white": 0}, "white must be a number above 0, got 0"),
        ({"white": "255"}, "white must be"),
        ({"mean": (0, 0)}, r"mean must be three numbers, got \(0, 0\)"),
        ({"mean": (0, 0, float("nan"))}, "mean must be"),
        ({"std": (1, 0, 1)}, "std must be three numbers above 0"),
        ({"std": (1, True, 1)}, "std must be"),
        ({"colour_order": "RGB"}, "colour_order must be rgb or bgr, got 'RGB'"),
        ({"output": 0}, "output must be a name, got 0"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        SegmenterConfig(**settings)


# ---- ONNX graphs


GRAPHS = {
    "dynamic": {},
    "height and width fixed": {"shape": ("batch", 3, 24, 32)},
    "all fixed": {"shape": (1, 3, 24, 32)},
    "a batch of three": {"shape": (3, 3, 24, 32)},
    "channels free": {"shape": ("b", "c", "h", "w")},
    "labels inside": {"labels": True},
    "external weights": {"external": True},
    "half input": {"dtype": "half"},
    "double input": {"dtype": "double"},
    "channels last": {"shape": ("b", "h", "w", 3), "channels_last": True},
    "channels last, fixed": {"shape": (1, 24, 32, 3), "channels_last": True},
    "channels last, labels inside": {
        "shape": (1, 24, 32, 3),
        "channels_last": True,
        "labels": True,
    },
}


@pytest.mark.parametrize("form", GRAPHS)
def test_a_graph_gives_what_the_network_gives(tmp_path, form):
    path = write_graph(tmp_path / "net.onnx", **GRAPHS[form])
    segmenter = Segmenter(OnnxNetwork(path), SPACE, PLAIN)
    if form == "half input":
        (labels,) = segmenter(PHOTOS[:1])
        assert (labels == LABELS[0]).mean() > 0.9
    else:
        assert_right(segmenter)


def test_a_graph_that_takes_bytes(tmp_path):
    shape = (1, 24, 32, 3)
    path = write_graph(tmp_path / "net.onnx", shape, "bytes", channels_last=True, white=255)
    assert_right(Segmenter(OnnxNetwork(path), SPACE, BYTES))
    with pytest.raises(ValueError, match=r"net\.onnx: takes bytes: wanted white 255, got 1"):
        Segmenter(OnnxNetwork(path), SPACE)


def test_classes_that_are_as_many_as_columns_are_told_apart(tmp_path):
    """(1, 12, 16, 12) is read by the layout of the input."""
    labels = [street(seed, 12, 16) for seed in range(2)]
    shape = (1, 12, 16, 3)
    path = write_graph(tmp_path / "net.onnx", shape, channels_last=True)
    segmenter = Segmenter(OnnxNetwork(path), SPACE, PLAIN)
    assert_right(segmenter, [photo(one) for one in labels], labels)
    upright = [one.T for one in labels]
    segmenter = Segmenter(colour_network(), SPACE, PLAIN)
    assert_right(segmenter, [photo(one) for one in upright], upright)


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("inside", [False, True])
def test_a_graph_of_torchs_own_exporter(tmp_path, fixed, inside):
    network = Then((lambda scores: scores.argmax(1)) if inside else (lambda scores: scores))
    dynamic = {0: torch.export.Dim.AUTO, 2: torch.export.Dim.AUTO, 3: torch.export.Dim.AUTO}
    torch.onnx.export(
        network.eval(),
        (torch.zeros(2, 3, 24, 32),),
        tmp_path / "net.onnx",
        dynamo=True,
        verbose=False,
        dynamic_shapes=None if fixed else (dynamic,),
    )
    graph = OnnxNetwork(tmp_path / "net.onnx")
    assert graph.size == ((24, 32) if fixed else (None, None))
    assert_right(Segmenter(graph, SPACE, PLAIN))


def test_a_fixed_size_is_the_size_of_the_settings(tmp_path):
    path = write_graph(tmp_path / "net.onnx", (1, 3, 24, 32))
    segmenter = Segmenter(OnnxNetwork(path), SPACE)
    assert segmenter.config.size == (24, 32)
    found = segmenter([photo(street(0, 50, 70)), photo(street(0, 24, 32))])
    assert [labels.shape for labels in found] == [(50, 70), (24, 32)]
    assert Segmenter(OnnxNetwork(path), SPACE, SegmenterConfig(size=(24, 32))).config.size
    with pytest.raises(ValueError, match="takes images of 24x32, the settings say 32x32"):
        Segmenter(OnnxNetwork(path), SPACE, SegmenterConfig(size=(32, 32)))


def test_a_size_that_is_fixed_by_half_wants_a_setting(tmp_path):
    path = write_graph(tmp_path / "net.onnx", (1, 3, 24, "w"))
    with pytest.raises(ValueError, match="takes images of 24xany; wanted a size"):
        Segmenter(OnnxNetwork(path), SPACE)
    segmenter = Segmenter(OnnxNetwork(path), SPACE, SegmenterConfig(size=(24, 32)))
    assert segmenter.config.size == (24, 32)


def test_an_ambiguous_graph_names_its_candidates(tmp_path):
    path = write_graph(tmp_path / "net.onnx", aux=True)
    wanted = (
        r"net\.onnx: several outputs could be labels: "
        r"found \(\?, 12, \?, \?\) tensor\(float\), aux \(\?, 12, \?, \?\) tensor\(float\)"
    )
    with pytest.raises(ValueError, match=wanted):
        Segmenter(OnnxNetwork(path), SPACE)
    config = SegmenterConfig(**{**vars(PLAIN), "output": "found"})
    assert_right(Segmenter(OnnxNetwork(path), SPACE, config))
    config = SegmenterConfig(output="fund")
    with pytest.raises(ValueError, match=r"no output 'fund'; the outputs are found \("):
        Segmenter(OnnxNetwork(path), SPACE, config)


def test_the_class_count_is_checked_before_any_image_is_read(tmp_path):
    path = write_graph(tmp_path / "net.onnx")
    with pytest.raises(ValueError, match=r"net\.onnx: no output fits .*cityscapes-trainids.* = 19"):
        Segmenter(OnnxNetwork(path), "cityscapes-trainids")


def graph_of(inputs, path):
    """A graph that only passes on its inputs."""
    nodes = [onnx.helper.make_node("Identity", [one.name], [f"{one.name}2"]) for one in inputs]
    outputs = [
        onnx.helper.make_tensor_value_info(f"{one.name}2", one.type.tensor_type.elem_type, None)
        for one in inputs
    ]
    model = onnx.helper.make_model(
        onnx.helper.make_graph(nodes, "none", inputs, outputs),
        opset_imports=[onnx.helper.make_opsetid("", 17)],
    )
    model.ir_version = 8
    onnx.save(model, path)
    return path


def value(name, shape, dtype=onnx.TensorProto.FLOAT):
    return onnx.helper.make_tensor_value_info(name, dtype, shape)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ([value("a", [1, 3, 4, 4]), value("b", [1])], "has inputs a, b; wanted one"),
        ([value("a", [1, 3, 4])], r"takes \(1, 3, 4\) tensor\(float\); wanted \(B, 3, H, W\)"),
        ([value("a", [1, 1, 4, 4])], r"takes \(1, 1, 4, 4\) .*; wanted images of 3 channels"),
        ([value("a", [1, 3, 4, 4], onnx.TensorProto.INT64)], r"tensor\(int64\); wanted"),
        ([value("a", None)], r"takes \(\.\.\.\) tensor\(float\); wanted"),
    ],
)
def test_a_graph_that_takes_no_image(tmp_path, inputs, message):
    with pytest.raises(ValueError, match=message):
        OnnxNetwork(graph_of(inputs, tmp_path / "net.onnx"))


@pytest.mark.parametrize("damage", ["text", "empty", "truncated", "weights gone", "missing"])
def test_a_damaged_graph_is_refused_in_one_line(tmp_path, damage, capfd):
    path = write_graph(tmp_path / "net.onnx", external=damage == "weights gone")
    whole = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "weights gone":
        (tmp_path / "net.data").unlink()
    else:
        path.write_bytes({"text": b"hello", "empty": b"", "truncated": whole[:-40]}[damage])
    with pytest.raises(ValueError, match=r"net\.onnx (does not exist|is no ONNX graph)") as refusal:
        OnnxNetwork(path)
    assert "\n" not in str(refusal.value)
    assert capfd.readouterr() == ("", ""), "the runtime keeps its log to itself"


@pytest.mark.parametrize("module", ["onnxruntime", "onnx"])
def test_a_missing_extra_is_named(tmp_path, module):
    path = write_graph(tmp_path / "net.onnx")
    code = (
        f"import sys; sys.modules[{module!r}] = None\n"
        "from ssrvlad_torch import Segmenter\n"
        f"Segmenter.load({str(path)!r}, {SPACE!r})._forward.func.digest()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install ssrvlad-torch[onnx]" in done.stderr


# ---- settings in a file


def test_a_settings_file_names_a_network_beside_it(tmp_path, monkeypatch):
    (tmp_path / "nets").mkdir()
    write_graph(tmp_path / "nets" / "net.onnx", aux=True)
    (tmp_path / "nets" / "net.yaml").write_text(
        "network: net.onnx\nsize: [24, 32]\nwhite: 1\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n"
        "colour_order: rgb\noutput: found\n"
    )
    monkeypatch.chdir(tmp_path)
    segmenter = Segmenter.load("nets/net.yaml", SPACE)
    assert segmenter.config == SegmenterConfig(
        size=(24, 32), mean=(0, 0, 0), std=(1, 1, 1), output="found"
    )
    assert_right(segmenter)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"cannot read the settings .*net\.yaml: No such file"),
        ("network: [", r"cannot read the settings .*net\.yaml: while parsing"),
        ("size: [4, 4]", r"net\.yaml names no network; wanted network: FILE\.onnx"),
        ("hello", "names no network"),
        ("network: 3", "names no network"),
        ("network: net.onnx\nmeans: 3", r"unknown setting 'means'; wanted size, white, mean"),
        ("network: net.onnx\nmean: 3", r"net\.yaml: mean must be three numbers, got 3"),
        ("network: none.onnx", r"none\.onnx does not exist"),
    ],
)
def test_a_bad_settings_file_is_refused_in_one_line(tmp_path, text, message):
    if text is not None:
        (tmp_path / "net.yaml").write_text(text)
    with pytest.raises(ValueError, match=message) as refusal:
        Segmenter.load(tmp_path / "net.yaml", SPACE)
    assert "\n" not in str(refusal.value)


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


def test_a_label_map_is_made_once(photos, cache):
    network = counted(colour_network())
    first = run(Segmenter(network, SPACE, PLAIN, cache), photos)
    assert network.images == len(entries(cache)) == 5
    again = run(Segmenter(network, SPACE, PLAIN, cache), photos)
    assert network.images == 5
    for name, labels in first.items():
        np.testing.assert_array_equal(labels, LABELS[int(name)])
        np.testing.assert_array_equal(again[name], labels)
        assert again[name].dtype == labels.dtype


def test_an_image_is_known_by_its_content_and_not_by_its_name(photos, cache, tmp_path):
    network = counted(colour_network())
    run(Segmenter(network, SPACE, PLAIN, cache), photos)
    write_photos(tmp_path / "others", [3, 9])
    (tmp_path / "others" / "3.png").rename(tmp_path / "others" / "300.png")
    found = run(Segmenter(network, SPACE, PLAIN, cache), str(tmp_path / "others"))
    np.testing.assert_array_equal(found["300"], LABELS[3])
    assert network.images == 6


def test_a_changed_image_is_segmented_anew(photos, cache, tmp_path):
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    run(segmenter, photos)
    Image.fromarray(PHOTOS[4]).save(tmp_path / "photos" / "0.png")
    np.testing.assert_array_equal(run(segmenter, photos)["0"], LABELS[4])


def test_other_weights_settings_or_class_counts_have_entries_of_their_own(photos, cache):
    other = colour_network()
    other.bias.data[3] += 1e-3
    mask = Then(OUTPUTS["tensor"])
    mask.register_buffer("mask", torch.zeros(3), persistent=False)
    variants = [
        Segmenter(colour_network(), SPACE, PLAIN, cache),
        Segmenter(other, SPACE, PLAIN, cache),
        Segmenter(colour_network().double(), SPACE, PLAIN, cache),
        Segmenter(nn.Sequential(colour_network()), SPACE, PLAIN, cache),
        Segmenter(Then(OUTPUTS["tensor"]), SPACE, PLAIN, cache),
        Segmenter(mask, SPACE, PLAIN, cache),
        Segmenter(colour_network(), SPACE, SegmenterConfig(), cache),
        Segmenter(colour_network(), SPACE, SegmenterConfig(size=(24, 32)), cache),
        Segmenter(colour_network(), SPACE, SegmenterConfig(colour_order="bgr"), cache),
        Segmenter(Then(OUTPUTS["ids"]), "cityscapes-trainids", PLAIN, cache),
    ]
    for count, segmenter in enumerate(variants, start=1):
        run(segmenter, photos)
        assert len(entries(cache)) == 5 * count


def test_a_change_of_the_code_is_noticed(photos, cache, tmp_path, monkeypatch):
    """Of a network with the same name, weights and text form."""
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    for sign in "+-":
        source = f"""
import networks

class Network(networks.Strided):
    def forward(self, images):
        return {sign}super().forward(images)
"""
        (tmp_path / f"code_{ord(sign)}.py").write_text(source)
        network = importlib.import_module(f"code_{ord(sign)}").Network(1)
        found.append(run(Segmenter(network, SPACE, PLAIN, cache), photos)["0"])
    np.testing.assert_array_equal(found[0], LABELS[0])
    assert (found[1] != LABELS[0]).all()


def test_weights_that_change_in_memory_are_noticed(photos, cache):
    network = counted(colour_network())
    segmenter = Segmenter(network, SPACE, PLAIN, cache)
    run(segmenter, photos)
    network.bias.data[:] = 0
    network.bias.data[4] = 100
    assert all((labels == 4).all() for labels in run(segmenter, photos).values())


@pytest.mark.parametrize("external", [False, True])
def test_a_graph_is_known_by_its_file_and_its_weights(photos, cache, tmp_path, external):
    def entries_after(white):
        path = write_graph(tmp_path / "net.onnx", external=external, white=white)
        run(Segmenter(OnnxNetwork(path), SPACE, PLAIN, cache), photos)
        return len(entries(cache))

    assert [entries_after(white) for white in (1.0, 1.0, 1.5, 1.0)] == [5, 5, 10, 10]
    assert (tmp_path / "net.data").exists() == external


def test_weights_in_subgraphs_are_part_of_a_graph(tmp_path):
    """An `If` whose branches hold external tensors, as constants and as initializers."""
    from ssrvlad_torch.segmentation import onnx_network

    def branch(name, tensor):
        out = value(f"{name}_out", [1])
        node = onnx.helper.make_node("Identity", [tensor.name], [out.name])
        return onnx.helper.make_graph([node], name, [], [out], [tensor])

    def external(name):
        tensor = onnx.numpy_helper.from_array(np.zeros(1, np.float32), name)
        onnx.external_data_helper.set_external_data(tensor, f"{name}.bin")
        tensor.ClearField("raw_data")
        return tensor

    node = onnx.helper.make_node(
        "If", ["which"], ["out"], then_branch=branch("a", external("x")),
        else_branch=branch("b", external("y")),
    )  # fmt: skip
    constant = onnx.helper.make_node("Constant", [], ["c"], value=external("z"))
    graph = onnx.helper.make_graph(
        [node, constant], "g", [value("which", [], onnx.TensorProto.BOOL)], [value("out", [1])]
    )
    onnx.save(onnx.helper.make_model(graph), tmp_path / "net.onnx")
    found = onnx_network._external_files(tmp_path / "net.onnx")
    assert found == [tmp_path / f"{name}.bin" for name in "xyz"]


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "text", "dangling link"])
def test_a_damaged_entry_is_made_anew(photos, cache, damage):
    network = counted(colour_network())
    segmenter = Segmenter(network, SPACE, PLAIN, cache)
    run(segmenter, photos)
    entry = entries(cache)[2]
    whole = entry.read_bytes()
    if damage == "flip":
        flip_byte(entry, len(whole) // 2)
    elif damage == "dangling link":
        entry.unlink()
        entry.symlink_to("nowhere")
    else:
        entry.write_bytes({"cut": whole[:-20], "empty": b"", "text": b"hello"}[damage])
    for name, labels in run(segmenter, photos).items():
        np.testing.assert_array_equal(labels, LABELS[int(name)])
    assert network.images == 6
    assert entry.read_bytes() == whole


def test_wide_ids_are_kept_and_those_that_no_png_can_hold_are_made_each_time(photos, cache):
    wide = counted(Then(lambda scores: scores.argmax(1) + 1000))
    segmenter = Segmenter(wide, SPACE, PLAIN, cache)
    first = run(segmenter, photos)
    assert {labels.dtype for labels in run(segmenter, photos).values()} == {np.dtype("uint16")}
    np.testing.assert_array_equal(first["0"], LABELS[0].astype(int) + 1000)
    assert wide.images == 5
    negative = counted(Then(lambda scores: scores.argmax(1) - 20))
    segmenter = Segmenter(negative, SPACE, PLAIN, cache.with_name("other"))
    for _ in range(2):
        np.testing.assert_array_equal(run(segmenter, photos)["0"], LABELS[0].astype(int) - 20)
    assert negative.images == 10


def test_images_that_cannot_be_read_or_segmented_leave_no_entry(photos, cache, tmp_path):
    (tmp_path / "photos" / "1.png").write_text("no image")

    def spoil(scores):
        scores[0] = torch.nan
        return scores

    results = run(Segmenter(Then(spoil), SPACE, PLAIN, cache), photos)
    assert [str(result)[:16] for result in results.values() if isinstance(result, ValueError)] == [
        "class scores hol",
        "is no image file",
    ]
    assert len(entries(cache)) == 3


@pytest.mark.parametrize("done", [0, 1, 3])
def test_ctrl_c_keeps_what_was_made(photos, cache, monkeypatch, done):
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
    network = counted(colour_network())

    def interrupt(module, arguments):
        if module.images == done + 1:
            raise KeyboardInterrupt

    handle = network.register_forward_pre_hook(interrupt)
    segmenter = Segmenter(network, SPACE, PLAIN, cache)
    with pytest.raises(KeyboardInterrupt):
        run(segmenter, photos)
    handle.remove()
    assert len(entries(cache)) == done
    network.images = 0
    assert len(run(segmenter, photos)) == 5
    assert network.images == 5 - done


def test_a_cache_that_cannot_be_written_is_an_error(photos, tmp_path):
    (tmp_path / "file").touch()
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, tmp_path / "file")
    with pytest.raises(OSError, match="file"):
        run(segmenter, photos)


def race(photos, cache, barrier):
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    barrier.wait()
    for name, labels in run(segmenter, photos).items():
        assert (labels == LABELS[int(name)]).all()


def test_several_processes_may_share_a_cache(photos, cache):
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(2)
    racers = [context.Process(target=race, args=(photos, cache, barrier)) for _ in range(2)]
    for racer in racers:
        racer.start()
    for racer in racers:
        racer.join()
        assert racer.exitcode == 0
    assert len(entries(cache)) == 5
    network = counted(colour_network())
    run(Segmenter(network, SPACE, PLAIN, cache), photos)
    assert network.images == 0
    assert not [name for _, _, names in os.walk(cache) for name in names if name[0] == "."]


def test_progress_counts_every_image_once(photos, cache, tmp_path):
    (tmp_path / "photos" / "1.png").write_text("no image")
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    for _ in range(2):
        told = []
        list(segmenter.label_maps(find_image_files([photos]), progress=told.append))
        assert sum(told) == 5


# ---- images into descriptors


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
def test_images_give_the_descriptors_of_their_label_maps(tmp_path, suffix):
    sizes = {7: (30, 20), 20: (130, 150)}
    for seed in range(24):
        size = sizes.get(seed, (24, 32))
        write_photos(tmp_path / "photos" / "drive", [seed], suffix, size)
        write_street(tmp_path / "maps" / "drive" / f"{seed}.png", seed, *size)
    for kind in ("photos", "maps"):
        (tmp_path / kind / "poses.csv").write_text("frame,x,y,heading\ndrive/3,1,2,0.5\n")
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, tmp_path / "cache")
    database = Database.create(tmp_path / "town.ssrdb", HEAD.config)
    images = find_image_files([str(tmp_path / "photos" / "drive")])
    summary = encode_to_database(HEAD, images, database, segmenter=segmenter)
    assert (summary.encoded, summary.refused) == (24, [])
    by_images = database.load()
    by_maps, _ = encode_to_memory(HEAD, find_label_files([str(tmp_path / "maps" / "drive")]))
    assert by_images.frames == by_maps.frames
    assert torch.equal(by_images.descriptors, by_maps.descriptors)
    np.testing.assert_array_equal(by_images.poses, by_maps.poses)
    assert by_images.poses[3].tolist() == [1, 2, 0.5]


def test_an_image_that_cannot_be_encoded_is_refused_and_the_rest_lands(tmp_path):
    """One is cut off, of one the network gives an id that the label space does not have."""
    for seed in range(20):
        labels = street(seed) % SIGN
        labels[2:4, 5:8] = SIGN if seed == 7 else SKY
        write_image(tmp_path / "a" / f"{seed}.png", photo(labels))
    cut = tmp_path / "a" / "4.png"
    cut.write_bytes(cut.read_bytes()[:60])
    network = Then(lambda scores: scores.argmax(1).masked_fill_(scores.argmax(1) == SIGN, 99))
    segmenter = Segmenter(network, SPACE, PLAIN)
    files = find_image_files([str(tmp_path / "a")])
    frames, refused = encode_to_memory(HEAD, files, segmenter=segmenter)
    assert frames.frames == tuple(f"a/{seed}" for seed in range(20) if seed not in (4, 7))
    assert [refusal.frame for refusal in refused] == ["a/4", "a/7"]
    assert refused[0].reason == f"{cut}: Truncated File Read"
    assert f"{tmp_path}/a/7.png: label id 99 (6 pixels) is not in" in refused[1].reason


def test_a_segmenter_of_another_label_space_is_refused(tmp_path):
    files = find_image_files([str(write_photos(tmp_path / "a"))])
    segmenter = Segmenter(colour_network(), "synthia", PLAIN)
    with pytest.raises(ValueError, match="gives labels of synthia, the head reads camvid-11"):
        encode_to_memory(HEAD, files, segmenter=segmenter)


def test_ctrl_c_leaves_a_valid_database_and_the_next_run_completes_it(tmp_path, monkeypatch):
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
    monkeypatch.setattr(encoding, "BATCH", 4)
    files = find_image_files([str(write_photos(tmp_path / "a", range(20)))])
    network = counted(colour_network())

    def interrupt(module, arguments):
        if module.images == 18:
            raise KeyboardInterrupt

    handle = network.register_forward_pre_hook(interrupt)
    segmenter = Segmenter(network, SPACE, PLAIN, tmp_path / "cache")
    database = Database.create(tmp_path / "db", HEAD.config)
    with pytest.raises(KeyboardInterrupt):
        encode_to_database(HEAD, files, database, segmenter=segmenter)
    handle.remove()
    landed = len(Database.open(tmp_path / "db").load().frames)
    assert 0 < landed <= 17
    network.images = 0
    again = encode_to_database(HEAD, files, Database.open(tmp_path / "db"), segmenter=segmenter)
    assert again.encoded == 20 - landed
    assert network.images == 3, "17 were in the cache"
    for seed in range(20):
        write_street(tmp_path / "b" / f"{seed}.png", seed)
    expected, _ = encode_to_memory(HEAD, find_label_files([str(tmp_path / "b")]))
    found = Database.open(tmp_path / "db").load()
    assert torch.equal(found.descriptors, expected.descriptors)


def test_an_output_that_is_not_recognised_ends_the_run_and_keeps_the_database(tmp_path):
    files = find_image_files([str(write_photos(tmp_path / "a"))])
    database = Database.create(tmp_path / "db", HEAD.config)
    segmenter = Segmenter(Then(lambda scores: scores[:, :7]), SPACE, PLAIN)
    with pytest.raises(ValueError, match="no output fits"):
        encode_to_database(HEAD, files, database, segmenter=segmenter)
    assert len(Database.open(tmp_path / "db")) == 0
