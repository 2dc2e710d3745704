"""Modules as ONNX graphs, traced by torch's exporter, and graphs joined to one."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from ..files import one_line, requiring

if TYPE_CHECKING:
    import onnx

OPSET = 18
"""Of every graph: the first opset with bitwise operators."""

Axes = Sequence[int | str | None]
"""Lengths and names of axes; one with a name, or ``None``, is dynamic."""


class _OfList(nn.Module):
    """A method of a module as one whose arguments are a list, however many they are."""

    def __init__(self, module: nn.Module, method: str) -> None:
        super().__init__()
        self.module, self.method = module, method

    def forward(self, inputs: list[Tensor]) -> Any:
        return getattr(self.module, self.method)(*inputs)


def traced(
    module: nn.Module,
    inputs: Mapping[str, tuple[Tensor, Axes]],
    outputs: Mapping[str, Axes],
    method: str = "forward",
) -> onnx.ModelProto:
    """A module as a graph; ``inputs`` are by name, in order, an example and axes, ``outputs`` axes.
    One that cannot be traced is a ValueError; no extra ``onnx``, an ImportError."""
    with requiring("onnx", "ONNX graphs need"):
        import onnxscript  # noqa: F401
    log = logging.getLogger("torch.onnx")
    level, auto = log.level, torch.export.Dim.AUTO
    log.setLevel(logging.ERROR)
    dynamic = [
        {number: auto for number, axis in enumerate(axes) if not isinstance(axis, int)}
        for _, axes in inputs.values()
    ]
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            recorded = torch.export.export(
                _OfList(module, method).eval(),
                ([example for example, _ in inputs.values()],),
                dynamic_shapes=(dynamic,) if any(dynamic) else None,
            )
            program = torch.onnx.export(
                recorded,
                input_names=list(inputs),
                output_names=list(outputs),
                opset_version=OPSET,
                dynamo=True,
                custom_translation_table={torch.ops.aten.floor_divide.default: _divided},
                verbose=False,
                optimize=False,  # its rules of rewriting take long and make no runtime faster
            )
            assert program is not None
            _tidy(program.model)
    except Exception as error:  # the exporter can raise anything
        raise ValueError(f"cannot be traced: {one_line(error)}") from error
    finally:
        log.setLevel(level)
    model: onnx.ModelProto = program.model_proto
    ends = {**outputs, **{name: axes for name, (_, axes) in inputs.items()}}
    for value in (*model.graph.output, *model.graph.input):
        for axis, form in zip(value.type.tensor_type.shape.dim, ends[value.name], strict=True):
            if isinstance(form, int):
                axis.dim_value = form
            elif form is not None:
                axis.dim_param = form
    return model


def _tidy(model: Any) -> None:
    """Folds the constants of a model of onnx_ir, and leaves out what is unused or there twice."""
    from onnx_ir.passes import common
    from onnxscript import optimizer

    optimizer.fold_constants(model, onnx_shape_inference=True)
    for change in (
        common.RemoveUnusedNodesPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.LiftSubgraphInitializersToMainGraphPass(),
        common.DeduplicateInitializersPass(),
        common.CommonSubexpressionEliminationPass(),
        common.OutputFixPass(),
        common.NameFixPass(),
        common.ClearMetadataAndDocStringPass(),
    ):
        change(model)


def _divided(number: Any, divisor: Any) -> Any:
    """Division rounded down. In stages int32 is not negative, and needs no correction."""
    from onnxscript import INT32
    from onnxscript import opset18 as op
    from onnxscript.function_libs.torch_lib.ops.core import aten_floor_divide

    return (
        op.Div(number, divisor)
        if number.dtype == INT32.dtype
        else aten_floor_divide(number, divisor)
    )


def rename(graph: onnx.GraphProto, new: Callable[[str], str]) -> None:
    """Renames every node and value of a graph and of its subgraphs. `onnx.compose.add_prefix` does
    not rename the outer values that a loop body uses."""
    for node in graph.node:
        node.name = new(node.name)
        node.input[:] = [name and new(name) for name in node.input]
        node.output[:] = [name and new(name) for name in node.output]
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        value.name = new(value.name)
    for attribute in (attribute for node in graph.node for attribute in node.attribute):
        for subgraph in [attribute.g] if attribute.HasField("g") else attribute.graphs:
            rename(subgraph, new)


def join(
    models: Sequence[onnx.ModelProto],
    prefixes: Sequence[str],
    joints: Sequence[list[tuple[str, str]]],
) -> onnx.ModelProto:
    """One model that runs models of one opset in sequence; they are renamed in place by prefixes,
    but for the inputs of the first and the outputs of the last. ``joints`` are, between two models,
    pairs of an output and the input that it feeds."""
    from onnx import compose, helper

    def prefixed(prefix: str, unchanged: set[str], name: str) -> str:
        return name if name in unchanged or not name else prefix + name

    graphs, last = [model.graph for model in models], len(models) - 1
    for number, (graph, prefix) in enumerate(zip(graphs, prefixes, strict=True)):
        ends = [] if 0 < number < last else graph.output if number else graph.input
        rename(graph, partial(prefixed, prefix, {value.name for value in ends}))
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


def with_opset(model: onnx.ModelProto, version: int) -> onnx.ModelProto:
    """The model, converted to an opset if its own is lower, or a ValueError."""
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
    versions = [entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")]
    return int(max(versions, default=1))


def interface(model: onnx.ModelProto) -> dict[str, Any]:
    """The opset, and dtype and shape of each input and output by name."""
    from onnx import helper

    def forms(values: Iterable[onnx.ValueInfoProto]) -> dict[str, Any]:
        kinds = {value.name: value.type.tensor_type for value in values}
        return {
            name: {
                "dtype": helper.tensor_dtype_to_np_dtype(kind.elem_type).name,
                "shape": [axis.dim_param or axis.dim_value or None for axis in kind.shape.dim],
            }
            for name, kind in kinds.items()
        }

    graph = model.graph
    return {"opset": opset(model), "inputs": forms(graph.input), "outputs": forms(graph.output)}
