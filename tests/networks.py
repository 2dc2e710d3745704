"""Tiny segmentation networks that are right, as modules and as ONNX graphs; shared by the tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch
from drawings import SPACE
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from ssrvlad_torch.segmentation.segmenter import SegmenterConfig
from ssrvlad_torch.taxonomy import colourise, palette

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
    """An ``(H, W, 3)`` image of a world whose things are painted in their label's colours."""
    return colourise(labels, SPACE)


def colour_network(white: float = 1.0) -> nn.Conv2d:
    """A 1x1 convolution that gives each colour its own class: colours that are as far from a
    class's colour as they are score minus the square of that distance, up to what all share."""
    colours = torch.from_numpy(palette(SPACE)[:CLASSES]).double() / 255
    network = nn.Conv2d(3, CLASSES, 1)
    network.weight.data = (2 * colours / white)[:, :, None, None].float()
    network.bias.data = -colours.square().sum(1).float()
    return network.requires_grad_(False)


class Strided(nn.Module):
    """The colour network on every so many-th pixel."""

    def __init__(self, stride: int) -> None:
        super().__init__()
        self.network, self.stride = colour_network(), stride

    def forward(self, images: Tensor) -> Tensor:
        return self.network(images[:, :, :: self.stride, :: self.stride])


class Then(nn.Module):
    """The colour network, and a function of its scores."""

    def __init__(self, function: object) -> None:
        super().__init__()
        self.network, self.function = colour_network(), function

    def forward(self, images: Tensor) -> object:
        return self.function(self.network(images))


def write_graph(
    path: Path,
    shape: tuple[int | str, ...] = ("batch", 3, "height", "width"),
    dtype: str = "float",
    labels: bool = False,
    channels_last: bool = False,
    aux: bool = False,
    external: bool = False,
    white: float = 1.0,
) -> Path:
    """The colour network as an ONNX graph, node by node.

    Args:
        path: the file to write.
        shape: of its input.
        dtype: of its input, a key of ``DTYPES``.
        labels: its output are int64 ids ``(B, 1, H, W)``, not scores.
        channels_last: its input and output are ``(B, H, W, C)``.
        aux: a second output, ``aux``, has scores that are all wrong.
        external: its weights lie in a file of their own beside it.
        white: the number for the brightest pixel.
    """
    network = colour_network(white)
    weights = {"weight": network.weight.numpy(), "bias": network.bias.numpy()}
    nodes = [helper.make_node("Cast", ["images"], ["floats"], to=TensorProto.FLOAT)]
    transposed = "floats"
    if channels_last:
        nodes.append(helper.make_node("Transpose", ["floats"], ["planes"], perm=[0, 3, 1, 2]))
        transposed = "planes"
    nodes.append(helper.make_node("Conv", [transposed, "weight", "bias"], ["classes"]))
    if labels:
        nodes.append(helper.make_node("ArgMax", ["classes"], ["found"], axis=1, keepdims=1))
    elif channels_last:
        nodes.append(helper.make_node("Transpose", ["classes"], ["found"], perm=[0, 2, 3, 1]))
    else:
        nodes.append(helper.make_node("Identity", ["classes"], ["found"]))
    kind = TensorProto.INT64 if labels else TensorProto.FLOAT
    outputs = [helper.make_tensor_value_info("found", kind, [None] * 4)]
    if aux:
        nodes.append(helper.make_node("Neg", ["classes"], ["aux"]))
        outputs.append(helper.make_tensor_value_info("aux", TensorProto.FLOAT, [None] * 4))
    images = helper.make_tensor_value_info("images", DTYPES[dtype], shape)
    initializers = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "colours", [images], outputs, initializers)
    opset = [helper.make_opsetid("", 17)]
    model = onnx.shape_inference.infer_shapes(helper.make_model(graph, opset_imports=opset))
    model.ir_version = 8
    path.with_suffix(".data").unlink(missing_ok=True)  # the library would append to it
    options = {"save_as_external_data": True, "location": f"{path.stem}.data", "size_threshold": 0}
    onnx.save(model, path, **(options if external else {}))
    return path


def write_segformer(folder: Path) -> Path:
    """A tiny SegFormer with random weights, as transformers saves it."""
    transformers = pytest.importorskip("transformers")
    names = ["road", "sidewalk", "building", "pole", "vegetation", "sky", "car", "thing"]
    torch.manual_seed(0)
    config = transformers.SegformerConfig(
        depths=[1] * 4, hidden_sizes=[8, 16, 24, 32], decoder_hidden_size=16,
        id2label=dict(enumerate(names)), label2id={name: n for n, name in enumerate(names)},
    )  # fmt: skip
    transformers.SegformerForSemanticSegmentation(config).save_pretrained(folder)
    size = {"height": 64, "width": 96}
    transformers.SegformerImageProcessorPil(size=size).save_pretrained(folder)
    return folder
