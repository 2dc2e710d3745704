"""Tiny exact segmentation networks, as modules and as ONNX graphs, and photographs of the painted
world that they label."""

import json
import shutil
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch
import torch.nn.functional as F
from drawings import SPACE
from helpers import street, write_image, write_map
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter, SegmenterConfig
from ssrvlad_torch.taxonomy import colourise, label_space, palette

CLASSES = 12
PLAIN = SegmenterConfig(mean=(0, 0, 0), std=(1, 1, 1))
"""Colours from 0 to 1 and nothing else."""

DTYPES = {
    "float": TensorProto.FLOAT,
    "half": TensorProto.FLOAT16,
    "double": TensorProto.DOUBLE,
    "bytes": TensorProto.UINT8,
}


def photo(labels: npt.NDArray[np.integer]) -> npt.NDArray[np.uint8]:
    """An ``(H, W, 3)`` image: each pixel has the colour of its label."""
    return colourise(labels, SPACE)


def colour_network(white: float = 1.0) -> nn.Conv2d:
    """A 1x1 convolution that gives each colour its class: a score is minus the squared distance to
    the class's colour, plus a term that all classes share."""
    colours = torch.from_numpy(palette(SPACE)[:CLASSES]).double() / 255
    network = nn.Conv2d(3, CLASSES, 1)
    network.weight.data = (2 * colours / white)[:, :, None, None].float()
    network.bias.data = -colours.square().sum(1).float()
    return network.requires_grad_(False)


class Coloured(nn.Module):
    """A network around the colour network, `network`."""

    def __init__(self) -> None:
        super().__init__()
        self.network = colour_network()


class Strided(Coloured):
    """The colour network on every ``stride``-th pixel."""

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.stride = stride

    def forward(self, images: Tensor) -> Tensor:
        return self.network(images[:, :, :: self.stride, :: self.stride])


class Then(Coloured):
    """The colour network, and a function of its scores."""

    def __init__(self, function: object) -> None:
        super().__init__()
        self.function = function

    def forward(self, images: Tensor) -> object:
        return self.function(self.network(images))


class Street(nn.Module):
    """A network like real ones, with random weights: an encoder down to stride 16, which also sees
    smaller copies of the picture and weighs channels by their means, and a decoder."""

    CHANNELS = (8, 16, 32, 24)

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        before = (3, *self.CHANNELS)
        pairs = zip(before, self.CHANNELS, strict=False)
        self.steps = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in pairs)
        self.stages = nn.ModuleList(nn.Conv2d(c + 3, c, 3, padding=1) for c in self.CHANNELS)
        self.narrow = nn.Conv2d(32, 32, 1)
        self.act = nn.ModuleList(nn.ReLU(inplace=True) for _ in self.CHANNELS)
        self.up = nn.ConvTranspose2d(24, 48, 2, 2)
        self.decoder = nn.Conv2d(80, 64, 3, padding=1)
        self.scores = nn.Conv2d(64, 12, 1)
        self.eval().requires_grad_(False)

    def forward(self, images: Tensor) -> Tensor:
        x, skips = images, []
        for step, stage, act in zip(self.steps, self.stages, self.act, strict=True):
            x = step(x)
            small = F.interpolate(images, x.shape[2:])
            x = act(stage(torch.cat((x * x.mean((2, 3), keepdim=True).sigmoid(), small), 1)))
            skips.append(x)
        x = self.decoder(torch.cat((self.up(x), self.narrow(skips[2])), 1))
        return F.interpolate(self.scores(x), images.shape[2:], mode="bilinear")


def shared_street() -> Street:
    """`Street` with one activation module, which runs four times."""
    network = Street()
    network.act = nn.ModuleList([network.act[0]] * 4)
    return network


def write_street(path: Path, half: bool = False) -> Path:
    """`Street` as an ONNX graph with free axes, perhaps in half precision."""
    path.write_bytes(street_graph(half).SerializeToString())
    return path


@cache
def street_graph(half: bool) -> onnx.ModelProto:
    network, example = Street(), torch.rand(2, 3, 64, 96)
    if half:
        network, example = network.half(), example.half()
    axes = dict.fromkeys((0, 2, 3), torch.export.Dim.DYNAMIC)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network, (example,), input_names=["images"], output_names=["scores"],
            dynamo=True, verbose=False, dynamic_shapes=(axes,),
        )  # fmt: skip
    return program.model_proto


def write_graph(
    path: Path,
    shape: tuple[int | str, ...] = ("batch", 3, "height", "width"),
    dtype: str = "float",
    labels: bool = False,
    channels_last: bool = False,
    aux: bool = False,
    external: bool = False,
    white: float = 1.0,
    alone: bool = False,
    quantised: bool = False,
) -> Path:
    """The colour network as an ONNX graph, node by node; ``dtype`` is a key of ``DTYPES``.

    With ``labels`` the output is int64 ids ``(B, 1, H, W)``, of one picture ``alone`` ``(H, W)``;
    ``quantised`` it is int8 class scores. With ``channels_last`` input and output are so, ``aux``
    adds an output of wrong scores, ``external`` stores the weights beside the file, both as links
    to other names, as in the cache of the Hugging Face hub, ``white`` is the brightest pixel.
    """
    network = colour_network(white)
    weights = {"weight": network.weight.numpy(), "bias": network.bias.numpy()}
    order = [0, 3, 1, 2] if channels_last else [0, 1, 2, 3]
    nodes = [
        helper.make_node("Cast", ["images"], ["floats"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["floats"], ["planes"], perm=order),
        helper.make_node("Conv", ["planes", "weight", "bias"], ["classes"]),
    ]
    if labels:
        nodes.append(helper.make_node("ArgMax", ["classes"], ["found"], axis=1, keepdims=1))
        if alone:
            nodes[-1].output[0] = "ids"
            nodes.append(helper.make_node("Squeeze", ["ids"], ["found"]))
    elif quantised:
        weights |= {"depth": np.array(CLASSES), "ends": np.array([0, 127], np.float32)}
        nodes += [
            helper.make_node("ArgMax", ["classes"], ["ids"], axis=1, keepdims=0),
            helper.make_node("OneHot", ["ids", "depth", "ends"], ["hot"], axis=1),
            helper.make_node("Cast", ["hot"], ["found"], to=TensorProto.INT8),
        ]
    elif channels_last:
        nodes.append(helper.make_node("Transpose", ["classes"], ["found"], perm=[0, 2, 3, 1]))
    else:
        nodes.append(helper.make_node("Identity", ["classes"], ["found"]))
    kind = TensorProto.INT64 if labels else TensorProto.INT8 if quantised else TensorProto.FLOAT
    outputs = [helper.make_tensor_value_info("found", kind, [None] * (2 if alone else 4))]
    if aux:
        nodes.append(helper.make_node("Neg", ["classes"], ["aux"]))
        outputs.append(helper.make_tensor_value_info("aux", TensorProto.FLOAT, [None] * 4))
    images = helper.make_tensor_value_info("images", DTYPES[dtype], shape)
    initializers = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "colours", [images], outputs, initializers)
    opset = [helper.make_opsetid("", 17)]
    model = onnx.shape_inference.infer_shapes(helper.make_model(graph, opset_imports=opset))
    model.ir_version = 8
    if not external:
        onnx.save(model, path)
        return path
    weights_file = path.with_suffix(".data")
    options = {"location": weights_file.name, "size_threshold": 0}
    for file in (path, weights_file):
        file.unlink(missing_ok=True)  # the library would append to it
    onnx.save(model, path, save_as_external_data=True, **options)
    for file in (path, weights_file):
        blob = path.parent / "blobs" / file.suffix[1:]
        blob.parent.mkdir(exist_ok=True)
        file.replace(blob)
        file.symlink_to(blob)
    return path


NAMES = ["road", "sidewalk", "building", "pole", "vegetation", "sky", "car", "thing"]
"""Class names of the tiny published models."""


def write_published(folder: Path, family: str = "Segformer") -> Path:
    """A tiny model of a family, the beginning of the names of its classes in transformers, with
    random weights, as transformers saves it."""
    library = pytest.importorskip("transformers")
    torch.manual_seed(0)
    ids = {"id2label": dict(enumerate(NAMES)), "label2id": {n: i for i, n in enumerate(NAMES)}}
    settings, task, processor = _published(library, family)
    config = getattr(library, f"{family}Config")(**settings, **ids)
    getattr(library, f"{family}For{task}Segmentation")(config).save_pretrained(folder)
    getattr(library, f"{family}ImageProcessorPil")(**processor).save_pretrained(folder)
    return folder


def _published(library: Any, family: str) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Settings of a tiny model, what it is for, and the settings of its image processor."""
    square = {"size": {"height": 64, "width": 64}}
    vit = {"hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2,
           "intermediate_size": 32, "image_size": 64, "patch_size": 16}  # fmt: skip
    swin = library.SwinConfig(
        image_size=64, embed_dim=16, depths=[1] * 4, num_heads=[1] * 4, window_size=4,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    masks = {"backbone_config": swin, "hidden_dim": 32, "dim_feedforward": 32, "num_queries": 10,
             "encoder_feedforward_dim": 32, "encoder_layers": 1, "decoder_layers": 3,
             "num_attention_heads": 2}  # fmt: skip
    if family == "Segformer":
        sizes = {"depths": [1] * 4, "hidden_sizes": [8, 16, 24, 32], "decoder_hidden_size": 16}
        return sizes, "Semantic", {"size": {"height": 64, "width": 96}}
    if family == "Beit":
        return {**vit, "out_indices": [0, 1, 2, 3]}, "Semantic", {**square, "do_center_crop": False}
    assert family == "Mask2Former"
    sides = {"size": {"shortest_edge": 64, "longest_edge": 128}, "size_divisor": 32}
    return {**masks, "feature_size": 32, "mask_feature_size": 32}, "Universal", sides


LABELS = [street(seed) for seed in range(5)]
PHOTOS = [photo(labels) for labels in LABELS]
NOISE = np.random.default_rng(0).integers(0, 256, (17, 23, 3), np.uint8)


def assert_right(segmenter, photos=PHOTOS, expected=LABELS):
    for labels, right in zip(segmenter(photos), expected, strict=True):
        np.testing.assert_array_equal(labels, right)
        assert labels.dtype == np.uint8


def write_photos(folder, seeds=range(5), size=(24, 32)):
    for seed in seeds:
        write_image(folder / f"{seed}.png", photo(street(seed, *size)))
    return folder


def write_settings(folder, more=""):
    """``net.onnx``, which labels this world, and ``net.yaml``, its settings."""
    write_graph(folder / "net.onnx")
    path = folder / "net.yaml"
    path.write_text(f"network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n{more}")
    return path


def write_named_network(folder):
    """`write_settings`, of a graph that says what its classes are."""
    settings = write_settings(folder)
    model = onnx.load(folder / "net.onnx")
    names = {label.id: label.name for label in label_space(SPACE).classes}
    onnx.helper.set_model_props(model, {"id2label": json.dumps(names)})
    onnx.save(model, folder / "net.onnx")
    return settings


def counted(network):
    """Counts the images that a network is given, in ``network.images``."""
    network.images = torch.zeros((), dtype=torch.int64)

    def count(module, arguments):
        module.images += len(arguments[0])

    network.register_forward_pre_hook(count)
    return network


def write_coloured(folder):
    """The colour network as ``seg.onnx``, and the fused files: ``place.onnx``, or ``net.onnx`` and
    ``head.onnx``."""
    network = OnnxNetwork(write_graph(folder / "seg.onnx"))
    segmenter, config = Segmenter(network, SPACE, PLAIN), SSRVLADConfig(labels_as=SPACE)
    fuse(segmenter, config, folder / "place.onnx")
    fuse(segmenter, config, folder / "net.onnx", folder / "head.onnx")


def write_drives(folder):
    """A network with features as ``net.yaml``, photos in ``monday`` and ``today``, and the fused
    files: ``place.onnx``, or ``net.onnx`` and ``head.onnx``."""
    write_street(folder / "seg.onnx")
    settings = "network: seg.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\nlabels_as: camvid-11\n"
    (folder / "net.yaml").write_text(settings)
    write_photos(folder / "monday", range(12), (96, 128))
    write_photos(folder / "today", range(3, 9), (96, 144))
    config = SSRVLADConfig(labels_as="camvid-11")
    fuse(folder / "net.yaml", config, folder / "place.onnx")
    fuse(folder / "net.yaml", config, folder / "net.onnx", folder / "head.onnx")


def write_other_drives(drives, folder, monday, today):
    """The files of `write_drives`, with other photos."""
    for name in ("seg.onnx", "net.yaml", "place.onnx", "net.onnx", "head.onnx"):
        shutil.copy(drives / name, folder)
    write_photos(folder / "monday", monday, (96, 128))
    write_photos(folder / "today", today, (96, 128))


def write_moved_drives(ssrvlad, drives, folder, exported):
    """`write_other_drives`, where the photos of ``today`` are moved by two cells, and ``monday`` as
    a database, also in NumPy's form. Returns the words that query it."""
    write_other_drives(drives, folder, range(36), ())
    for seed in range(2, 35):
        pixels = np.roll(photo(street(seed, 96, 128)), 14, axis=1)
        write_image(folder / "today" / f"{seed}.png", pixels)
    network = folder / "net.yaml"
    database = write_map(ssrvlad, exported, folder / "monday", segmenter=network)
    return ("query", database, folder / "today", "--segmenter", network, "--json")
