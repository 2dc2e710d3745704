"""Pictures to label maps, features and HOG as one ONNX graph: traced parts and the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..channels.channel import FEATURES as NAME
from ..channels.hog import HOG, luma
from ..files import one_line
from ..segmentation.features import NetworkFeatures
from ..segmentation.label_network import LabelNetwork
from ..segmentation.network_outputs import classes_of, enlarged, scores_along
from ..segmentation.onnx_files import load_model
from ..segmentation.onnx_network import OnnxNetwork
from ..segmentation.preparation import OF_SIDES, Preparation, SegmenterConfig
from ..stages.features import SHAPE, Features
from .trace import OPSET, Axes, join, opset, rename, traced, with_opset

if TYPE_CHECKING:
    import onnx

FEATURES = f"{NAME}/"
"""Prefix of the names of the nodes and tables that make features of activations."""

_IMAGE = ("B", "H", "W", 3)
_HISTOGRAMS: Axes = ["B", *HOG.shape]
EXAMPLE = (66, 98)
"""Height and width of the pictures that a module is traced with; the values are arbitrary."""


def label_graph(labels: LabelNetwork, features: NetworkFeatures | None = None) -> onnx.ModelProto:
    """A graph from ``image (B, H, W, 3)`` uint8 to ``labels (B, H, W)`` uint8 or int64, to
    ``hog (B, 480)`` float32, and with features to ``features (B, 16, 16, 16)`` uint8. A network
    that cannot be traced, and a graph that cannot be converted to `OPSET`, are a ValueError."""
    if not isinstance(labels.network, OnnxNetwork):
        return _traced_network(labels, features)
    from onnx.helper import make_empty_tensor_value_info

    network, names = labels.network, features.names if features else []
    model = with_opset(load_model(network.path), OPSET)
    config, version = labels.config, opset(model)
    prepare = _traced_preparation(config, network)
    size = config.size if isinstance(config.size, tuple) else (64, 96)
    with torch.inference_mode():
        example = torch.zeros(network.batch or 1, *size, 3, dtype=torch.uint8)
        labels.run(example)  # chooses the output and the axis of the classes
        values = network(labels.preparation(example), names=[str(labels.output), *names])
    output = values[str(labels.output)]
    shape: list[int | None] = [None] * output.ndim
    axis, classes = labels.axis, (0, 0)
    if axis is not None:
        shape[axis] = output.shape[axis]
        classes = config.classes or (0, output.shape[axis])
    decide = _traced_decision(output.dtype, tuple(shape), axis, classes)
    parts = [with_opset(prepare, version), model, with_opset(decide, version)]
    joints = [
        [("prepare/numbers", f"network/{network.input}")],
        [(f"network/{labels.output}", "decide/output"), ("prepare/picture", "decide/picture")],
    ]
    model.graph.output.extend(map(make_empty_tensor_value_info, names))
    joined = join(parts, ["prepare/", "network/", "decide/"], joints)
    if features:
        signs = _traced_features(features.signs, tuple(values[name].dtype for name in names))
        pairs = [(f"network/{name}", f"{FEATURES}{at}") for at, name in enumerate(names)]
        joined = join([joined, with_opset(signs, version)], ["", FEATURES], [pairs])
    histograms = f"prepare/{HOG.name}"
    ends = {value.name: value for value in joined.graph.output}
    outputs = [ends[name] for name in ("labels", NAME, histograms) if name in ends]
    del joined.graph.output[:]
    joined.graph.output.extend(outputs)
    rename(joined.graph, lambda name: HOG.name if name == histograms else name)
    return joined


class _Preparation(nn.Module):
    """The preparation, which also returns the picture for its size, and HOG."""

    def __init__(self, preparation: nn.Module, fed: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.preparation, self.fed = preparation, fed

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        return self.fed(self.preparation(image)), image[:, :, :, 0], HOG().histograms(luma(image))


class _Decision(nn.Module):
    """The axis of the classes and the decision, for an output of known layout."""

    def __init__(self, axis: int | None, classes: tuple[int, int], dtype: torch.dtype) -> None:
        super().__init__()
        self.axis, self.classes, self.dtype = axis, classes, dtype

    def forward(self, output: Tensor, picture: Tensor) -> Tensor:
        output = output[None] if output.ndim == 2 else output
        labels = classes_of(scores_along(output, self.axis, self.classes)).to(self.dtype)
        return enlarged(labels, *picture.shape[1:3])


class _Whole(nn.Module):
    """A `LabelNetwork` whose labels have a fixed dtype, HOG, and features if they are wanted."""

    def __init__(
        self, labels: LabelNetwork, dtype: torch.dtype, features: NetworkFeatures | None
    ) -> None:
        super().__init__()
        self.labels, self.dtype, self.features = labels, dtype, features

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        output, activations = self.labels.run(image, self.features.names if self.features else ())
        labels = enlarged(classes_of(output), *image.shape[1:3]).to(self.dtype)
        signs = [self.features(activations)] if self.features else []
        return labels, *signs, HOG().histograms(luma(image))


def _traced_network(labels: LabelNetwork, features: NetworkFeatures | None) -> onnx.ModelProto:
    example = torch.zeros(2, *EXAMPLE, 3, dtype=torch.uint8)
    try:
        with torch.inference_mode():
            narrow = labels.run(example)[0].is_floating_point()
    except RuntimeError as error:
        size = "x".join(map(str, labels.config.network_size(*EXAMPLE)))
        raise ValueError(
            f"fails with 2 pictures of {size}, and a file takes any number of any size: "
            f"{one_line(error)}{'' if labels.config.resizes else f'; {OF_SIDES}'}"
        ) from error
    module = _Whole(labels, torch.uint8 if narrow else torch.int64, features)
    signs: dict[str, Axes] = {NAME: ["B", *SHAPE]} if features else {}
    outputs = {"labels": ["B", "H", "W"], **signs, HOG.name: _HISTOGRAMS}
    return traced(module, {"image": (example, _IMAGE)}, outputs)


def _traced_features(module: Features, dtypes: tuple[torch.dtype, ...]) -> onnx.ModelProto:
    """Activations of some dtypes, with numbers as names, to signs."""
    inputs: dict[str, tuple[Tensor, Axes]] = {}
    for number, (channels, dtype) in enumerate(zip(module.channels, dtypes, strict=True)):
        example = torch.zeros(2, channels, 9 + number, 13 + number, dtype=dtype)
        inputs[str(number)] = example, ["B", channels, f"h{number}", f"w{number}"]
    return traced(module.cpu(), inputs, {NAME: ["B", *SHAPE]})


def _traced_preparation(config: SegmenterConfig, network: OnnxNetwork) -> onnx.ModelProto:
    module = _Preparation(Preparation(config), network.fed)
    example = torch.zeros(2, *EXAMPLE, 3, dtype=torch.uint8)
    forms: dict[str, Axes] = {"numbers": [None] * 4, "picture": ["B", "H", "W"]}
    return traced(module, {"image": (example, _IMAGE)}, {**forms, HOG.name: _HISTOGRAMS})


def _traced_decision(
    dtype: torch.dtype, shape: tuple[int | None, ...], axis: int | None, classes: tuple[int, int]
) -> onnx.ModelProto:
    scores = dtype.is_floating_point or (axis is not None and classes[1] > 1)
    narrow = classes[1] - classes[0] <= 256 if scores else dtype == torch.uint8
    module = _Decision(axis, classes, torch.uint8 if narrow else torch.int64)
    sizes = [2, *EXAMPLE][-len(shape) :] if axis is None else [2, 33, 49, 25]
    example = torch.zeros([n or m for n, m in zip(shape, sizes, strict=True)], dtype=dtype)
    axes: Axes = [n or f"n{number}" for number, n in enumerate(shape)]
    picture = torch.zeros(1 if len(shape) == 2 else 2, *EXAMPLE, dtype=torch.uint8)
    inputs = {"output": (example, axes), "picture": (picture, ["B", "H", "W"])}
    return traced(module, inputs, {"labels": ["B", "H", "W"]})
