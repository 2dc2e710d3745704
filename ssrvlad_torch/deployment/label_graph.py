"""Pictures to label maps as an ONNX graph: preparation, network and decision, traced and joined."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ..files import one_line
from ..onnx_files import load_model, rename
from ..segmentation.label_network import LabelNetwork
from ..segmentation.network_outputs import classes_of, enlarged
from ..segmentation.onnx_network import OnnxNetwork
from ..segmentation.preparation import Form, Preparation, SegmenterConfig
from .graph import OPSET

if TYPE_CHECKING:
    import onnx

_BYTES = 256
_EXAMPLE = (66, 98)
"""Height and width of the pictures that a module is traced with; the values are arbitrary."""


def label_graph(labels: LabelNetwork) -> onnx.ModelProto:
    """A graph from ``image (B, H, W, 3)`` uint8 to ``labels (B, H, W)`` uint8 or int64.

    A PyTorch network is traced together with preparation and decision. For an ONNX graph these two
    are traced and joined to it; a graph below the head's opset is converted to it.

    Raises:
        ValueError: the network cannot be traced, or the graph cannot be converted.
        ImportError: the extra ``onnx`` is not installed.
    """
    if not isinstance(labels.network, OnnxNetwork):
        return _traced_network(labels)
    network = labels.network
    model = with_opset(load_model(network.path), OPSET)
    config, version = labels.config, opset(model)
    prepare = _traced_preparation(config, network.form.dtype, network.form.channels_last)
    decide = _traced_decision(*_decision(labels))
    parts = [with_opset(prepare, version), model, with_opset(decide, version)]
    joints = [
        [("prepare/numbers", f"network/{network.input}")],
        [(f"network/{config.output}", "decide/output"), ("prepare/picture", "decide/picture")],
    ]
    joined = join(parts, ["prepare/", "network/", "decide/"], joints)
    outputs = [value for value in joined.graph.output if value.name == "labels"]
    del joined.graph.output[:]
    joined.graph.output.extend(outputs)
    return joined


def join(
    models: Sequence[onnx.ModelProto],
    prefixes: Sequence[str],
    joints: Sequence[list[tuple[str, str]]],
) -> onnx.ModelProto:
    """One model that runs several models in sequence.

    Args:
        models: models of one opset; they are renamed in place.
        prefixes: prefix of the names of each model. The inputs of the first model and the outputs
            of the last keep their names.
        joints: between two models, pairs of an output and the input that it feeds.
    """
    from onnx import compose, helper

    graphs, last = [model.graph for model in models], len(models) - 1
    for number, (graph, prefix) in enumerate(zip(graphs, prefixes, strict=True)):
        ends = [] if 0 < number < last else graph.output if number else graph.input
        rename(graph, partial(_prefixed, prefix, {value.name for value in ends}))
    joined = graphs[0]
    for graph, pairs in zip(graphs[1:], joints, strict=True):
        joined = compose.merge_graphs(joined, graph, pairs)
    del joined.value_info[:]
    imports = {entry.domain or "": entry for model in models for entry in model.opset_import}
    return helper.make_model(
        joined,
        opset_imports=list(imports.values()),
        functions=[function for model in models for function in model.functions],
        ir_version=max(model.ir_version for model in models),
    )


def _prefixed(prefix: str, unchanged: set[str], name: str) -> str:
    return name if name in unchanged or not name else prefix + name


def with_opset(model: onnx.ModelProto, version: int) -> onnx.ModelProto:
    """The model, converted to an opset if its own is lower.

    Raises:
        ValueError: it cannot be converted.
    """
    from onnx import version_converter

    if opset(model) >= version:
        return model
    try:
        return version_converter.convert_version(model, version)
    except Exception as error:  # the converter's own types, and protobuf's beyond 2 GB
        raise ValueError(
            f"cannot be converted from opset {opset(model)} to {version}: {one_line(error)}; "
            f"export it with opset {version} or newer"
        ) from error


def opset(model: onnx.ModelProto) -> int:
    """Version of the standard operators that a model uses."""
    versions = [each.version for each in model.opset_import if each.domain in ("", "ai.onnx")]
    return int(max(versions, default=1))


class _Preparation(nn.Module):
    """The preparation, which also returns the picture for its size."""

    def __init__(self, preparation: Preparation) -> None:
        super().__init__()
        self.preparation = preparation

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        return self.preparation(image), image[:, :, :, 0]


class _Decision(nn.Module):
    """The last steps of `LabelNetwork.forward`, for an output of known layout."""

    def __init__(self, axis: int | None, classes: tuple[int, int], dtype: torch.dtype) -> None:
        super().__init__()
        self.axis, self.classes, self.dtype = axis, classes, dtype

    def forward(self, output: Tensor, picture: Tensor) -> Tensor:
        if output.is_floating_point():
            output = output.movedim(self.axis or 1, 1)[:, slice(*self.classes)]
        elif self.axis is not None:
            output = output.squeeze(self.axis)
        labels = classes_of(output).to(self.dtype)
        return enlarged(labels, *picture.shape[1:3])


class _WithDtype(nn.Module):
    """A `LabelNetwork` whose labels have a fixed dtype."""

    def __init__(self, labels: LabelNetwork, dtype: torch.dtype) -> None:
        super().__init__()
        self.labels, self.dtype = labels, dtype

    def forward(self, image: Tensor) -> Tensor:
        labels: Tensor = self.labels(image)
        return labels.to(self.dtype)


def _traced_network(labels: LabelNetwork) -> onnx.ModelProto:
    example = torch.zeros(2, *_EXAMPLE, 3, dtype=torch.uint8)
    with torch.inference_mode():
        narrow = labels.outputs(example).is_floating_point()
    module = _WithDtype(labels, torch.uint8 if narrow else torch.int64)
    dims = {0: "B", 1: "H", 2: "W"}
    return _traced(module, {"image": (example, dims)}, {"labels": ["B", "H", "W"]})


def _traced_preparation(
    config: SegmenterConfig, dtype: torch.dtype, channels_last: bool
) -> onnx.ModelProto:
    module = _Preparation(Preparation(config, Form(dtype, channels_last)))
    example = torch.zeros(2, *_EXAMPLE, 3, dtype=torch.uint8)
    dims = {0: "B", 1: "H", 2: "W"}
    forms: dict[str, list[Any]] = {"numbers": [None] * 4, "picture": ["B", "H", "W"]}
    return _traced(module, {"image": (example, dims)}, forms)


def _traced_decision(
    dtype: torch.dtype, shape: tuple[int | None, ...], axis: int | None, classes: tuple[int, int]
) -> onnx.ModelProto:
    scores = dtype.is_floating_point
    narrow = classes[1] - classes[0] <= _BYTES if scores else dtype == torch.uint8
    module = _Decision(axis, classes, torch.uint8 if narrow else torch.int64)
    sizes = [2, *_EXAMPLE] if axis is None else [2, 33, 49, 25]
    example = torch.zeros([n or m for n, m in zip(shape, sizes, strict=True)], dtype=dtype)
    dynamic = {number: f"n{number}" for number, n in enumerate(shape) if n is None}
    picture = torch.zeros(2, *_EXAMPLE, dtype=torch.uint8)
    inputs = {"output": (example, dynamic), "picture": (picture, {0: "B", 1: "H", 2: "W"})}
    return _traced(module, inputs, {"labels": ["B", "H", "W"]})


def _decision(
    labels: LabelNetwork,
) -> tuple[torch.dtype, tuple[int | None, ...], int | None, tuple[int, int]]:
    """Dtype, shape, axis of the classes and range of the classes of a graph's output."""
    network, config = labels.network, labels.config
    assert isinstance(network, OnnxNetwork)
    size = config.size if isinstance(config.size, tuple) else (64, 96)
    with torch.inference_mode():
        example = torch.zeros(network.batch or 1, *size, 3, dtype=torch.uint8)
        labels.outputs(example)
        output = network(labels.preparation(example), names=[config.output])[str(config.output)]
    shape: list[int | None] = [None] * output.ndim
    if labels.axis is None or output.ndim == 3:
        return output.dtype, tuple(shape), None, (0, 0)
    channels = shape[labels.axis] = output.shape[labels.axis]
    return output.dtype, tuple(shape), labels.axis, config.classes or (0, channels)


def _traced(
    module: nn.Module,
    inputs: dict[str, tuple[Tensor, dict[int, str]]],
    outputs: dict[str, list[Any]],
) -> onnx.ModelProto:
    """A module as a graph with named inputs and outputs; named axes are dynamic.

    Raises:
        ValueError: it cannot be traced.
    """
    try:
        import onnxscript  # noqa: F401 - the exporter imports it
    except ImportError as error:
        raise ImportError("ONNX graphs need: pip install ssrvlad-torch[onnx]") from error
    log = logging.getLogger("torch.onnx")
    level, auto = log.level, torch.export.Dim.AUTO
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module.eval(),
                tuple(example for example, _ in inputs.values()),
                input_names=list(inputs),
                output_names=list(outputs),
                dynamic_shapes=tuple(dict.fromkeys(dims, auto) for _, dims in inputs.values()),
                opset_version=OPSET,
                dynamo=True,
                verbose=False,
            )
    except Exception as error:  # the exporter can raise anything
        raise ValueError(f"cannot be traced: {one_line(error)}") from error
    finally:
        log.setLevel(level)
    assert program is not None
    model: onnx.ModelProto = program.model_proto
    for value in model.graph.output:
        _name_axes(value, outputs[value.name])
    for value in model.graph.input:
        _name_axes(value, [inputs[value.name][1].get(n) for n in range(4)])
    return model


def _name_axes(value: onnx.ValueInfoProto, names: Sequence[str | None]) -> None:
    for axis, name in zip(value.type.tensor_type.shape.dim, names, strict=False):
        if name is not None:
            axis.dim_param = name
