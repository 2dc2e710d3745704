"""Diagnosis: the stage of the head's graph in which a runtime computes wrong numbers or fails."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..files import one_line
from .fuse import HEAD
from .runtimes import Arrays, OnnxRuntime, Runtime

if TYPE_CHECKING:
    import onnx

STAGE_TOLERANCE = 1e-6
"""Largest difference of floats inside the graph, relative to the largest number of the tensor."""


class Fault(NamedTuple):
    """An error of a runtime.

    Attributes:
        kind: ``"wrong"`` or ``"cannot run"``.
        place: the first stage whose outputs differ, or the node that cannot run.
        reason: what differs, or the error of the runtime.
    """

    kind: str
    place: str
    reason: str


def diagnose(model: onnx.ModelProto, inputs: Arrays, runtime: Runtime) -> Fault:
    """Finds where a runtime fails, or gives other numbers than ONNX Runtime on the CPU.

    If the outputs of all stages are the same, the place is ``"outputs"``: the graph differs from
    the module, or the runtime is only wrong when it optimises the whole graph.
    """
    try:
        runtime.open(model.SerializeToString())(inputs)
    except Exception as error:  # runtimes have no common error type
        return _failing_node(model, inputs, runtime, one_line(error))
    return _first_difference(model, inputs, runtime)


def _first_difference(model: onnx.ModelProto, inputs: Arrays, runtime: Runtime) -> Fault:
    outputs = list(_stage_outputs(model.graph))
    staged = _with_outputs(model, [name for _, name in outputs])
    expected = OnnxRuntime().open(staged)(inputs)
    try:
        got = runtime.open(staged)(inputs)
    except Exception as error:
        return Fault("wrong", "outputs", f"its stages cannot be compared: {one_line(error)}")
    for stage, name in outputs:
        reason = _difference(got[name], expected[name])
        if reason:
            return Fault("wrong", stage, f"{name}: {reason}")
    return Fault("wrong", "outputs", "every stage gives what ONNX Runtime gives on the CPU")


def _failing_node(model: onnx.ModelProto, inputs: Arrays, runtime: Runtime, reason: str) -> Fault:
    """The node that the runtime names; otherwise the last of the shortest part that fails."""
    named = [node for node in _all_nodes(model.graph) if node.name and node.name in reason]
    if named:
        return Fault("cannot run", _title(max(named, key=lambda node: len(node.name))), reason)
    nodes = model.graph.node
    runs, fails = 0, len(nodes)
    while fails - runs > 1:
        middle = (runs + fails) // 2
        try:
            runtime.open(_first_nodes(model, middle))(inputs)
        except Exception as error:
            fails, reason = middle, one_line(error)
        else:
            runs = middle
    return Fault("cannot run", _title(nodes[fails - 1]), reason)


def _title(node: onnx.NodeProto) -> str:
    return f"{node.name or node.output[0]} ({node.op_type})"


def _difference(got: npt.NDArray[Any], expected: npt.NDArray[Any]) -> str:
    """What differs in a tensor, or ``""``."""
    if got.shape != expected.shape:
        return f"shape {got.shape}, not {expected.shape}"
    if expected.dtype.kind == "f":
        bound = STAGE_TOLERANCE * max(1.0, float(np.abs(expected).max(initial=0)))
        differs = ~(np.abs(got.astype(np.float64) - expected) <= bound)
    else:
        differs = got != expected
    count = int(np.count_nonzero(differs))
    return f"{count} of {expected.size} numbers differ" if count else ""


def _stage_outputs(graph: onnx.GraphProto) -> Iterator[tuple[str, str]]:
    """Stage and name of every value that another stage uses or that is an output, in order.

    The network of a fused file is one stage: its inner numbers differ between runtimes.
    """
    prefix = HEAD if any(node.name.startswith(HEAD) for node in graph.node) else ""

    def stage_of(node: onnx.NodeProto) -> str:
        if not node.name.startswith(prefix):
            return "network"
        return node.name.removeprefix(prefix).split("/")[0]

    stages = {name: stage_of(node) for node in graph.node for name in node.output if name}
    shared = {output.name for output in graph.output}
    for node in graph.node:
        stage = stage_of(node)
        shared |= {name for name in _inputs(node) if stages.get(name, stage) != stage}
    for name, stage in stages.items():
        if name in shared:
            yield stage, name


def _inputs(node: onnx.NodeProto) -> Iterator[str]:
    """Names of the inputs of a node and of the nodes in its loop bodies."""
    yield from node.input
    for attribute in node.attribute:
        for inner in attribute.g.node:
            yield from _inputs(inner)


def _all_nodes(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            yield from _all_nodes(attribute.g)


def _first_nodes(model: onnx.ModelProto, count: int) -> bytes:
    """The first `count` nodes of a graph; what none of them uses is an output."""
    nodes = model.graph.node[:count]
    used = {name for node in nodes for name in _inputs(node)}
    ends = [name for node in nodes for name in node.output if name and name not in used]
    return _with_outputs(model, ends, nodes)


def _with_outputs(
    model: onnx.ModelProto,
    names: Sequence[str],
    nodes: Sequence[onnx.NodeProto] | None = None,
) -> bytes:
    """The graph, or its first nodes, with these values as outputs."""
    import onnx

    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    if nodes is not None:
        del copy.graph.node[len(nodes) :]
    del copy.graph.output[:]
    declared = {value.name: value for value in (*model.graph.value_info, *model.graph.output)}
    copy.graph.output.extend(declared.get(name, onnx.ValueInfoProto(name=name)) for name in names)
    del copy.metadata_props[:]
    return bytes(copy.SerializeToString())
