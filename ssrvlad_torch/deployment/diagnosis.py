"""Diagnosis: where a runtime goes wrong in the graph of a head, stage by stage."""

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
"""Largest difference of floats inside the graph, relative to the largest of the tensor."""


class Fault(NamedTuple):
    """Where a runtime goes wrong.

    Attributes:
        kind: ``"wrong"`` or ``"cannot run"``.
        place: the stage after which numbers differ first, or the node that cannot be run.
        reason: what differs there, or what the runtime says.
    """

    kind: str
    place: str
    reason: str


def diagnose(model: onnx.ModelProto, given: Arrays, runtime: Runtime) -> Fault:
    """Why a runtime fails on an input, or gives other numbers than ONNX Runtime on the CPU.

    Where the numbers of all stages are the same, the place is ``"outputs"``: the graph itself is
    another than the module, or the runtime is only wrong where it sees the whole.
    """
    try:
        runtime.open(model.SerializeToString())(given)
    except Exception as error:  # what runtimes raise has no common base
        return _failing_node(model, given, runtime, one_line(error))
    return _first_difference(model, given, runtime)


def _first_difference(model: onnx.ModelProto, given: Arrays, runtime: Runtime) -> Fault:
    passed_on = list(_passed_on(model.graph))
    watched = _with_outputs(model, [name for _, name in passed_on])
    expected = OnnxRuntime().open(watched)(given)
    try:
        got = runtime.open(watched)(given)
    except Exception as error:
        return Fault("wrong", "outputs", f"not told by its stages: {one_line(error)}")
    for stage, name in passed_on:
        reason = _difference(got[name], expected[name])
        if reason:
            return Fault("wrong", stage, f"{name}: {reason}")
    return Fault("wrong", "outputs", "every stage gives what ONNX Runtime gives on the CPU")


def _failing_node(model: onnx.ModelProto, given: Arrays, runtime: Runtime, reason: str) -> Fault:
    """The node that a runtime names, or else the first without which the graph runs."""
    named = [node for node in _all_nodes(model.graph) if node.name and node.name in reason]
    if named:
        return Fault("cannot run", _title(max(named, key=lambda node: len(node.name))), reason)
    nodes = model.graph.node
    runs, fails = 0, len(nodes)
    while fails - runs > 1:
        middle = (runs + fails) // 2
        try:
            runtime.open(_first_nodes(model, middle))(given)
        except Exception as error:
            fails, reason = middle, one_line(error)
        else:
            runs = middle
    return Fault("cannot run", _title(nodes[fails - 1]), reason)


def _title(node: onnx.NodeProto) -> str:
    return f"{node.name or node.output[0]} ({node.op_type})"


def _difference(got: npt.NDArray[Any], expected: npt.NDArray[Any]) -> str:
    """What is other in a tensor, or ``""``."""
    if got.shape != expected.shape:
        return f"shape {got.shape}, not {expected.shape}"
    if expected.dtype.kind == "f":
        bound = STAGE_TOLERANCE * max(1.0, float(np.abs(expected).max(initial=0)))
        other = ~(np.abs(got.astype(np.float64) - expected) <= bound)
    else:
        other = got != expected
    count = int(np.count_nonzero(other))
    return f"{count} of {expected.size} numbers differ" if count else ""


def _passed_on(graph: onnx.GraphProto) -> Iterator[tuple[str, str]]:
    """Stages and names of what is passed from one to another or out of the graph, in order.

    The network of a fused file is one stage: numbers inside it are not the same everywhere.
    """
    prefix = HEAD if any(node.name.startswith(HEAD) for node in graph.node) else ""

    def stage_of(node: onnx.NodeProto) -> str:
        if not node.name.startswith(prefix):
            return "network"
        return node.name.removeprefix(prefix).split("/")[0]

    made = {name: stage_of(node) for node in graph.node for name in node.output if name}
    wanted = {output.name for output in graph.output}
    for node in graph.node:
        stage = stage_of(node)
        wanted |= {name for name in _taken(node) if made.get(name, stage) != stage}
    for name, stage in made.items():
        if name in wanted:
            yield stage, name


def _taken(node: onnx.NodeProto) -> Iterator[str]:
    """What a node takes, also inside its loops."""
    yield from node.input
    for attribute in node.attribute:
        for inner in attribute.g.node:
            yield from _taken(inner)


def _all_nodes(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            yield from _all_nodes(attribute.g)


def _first_nodes(model: onnx.ModelProto, count: int) -> bytes:
    """A graph of so many nodes, that gives whatever they make and do not use themselves."""
    nodes = model.graph.node[:count]
    used = {name for node in nodes for name in _taken(node)}
    ends = [name for node in nodes for name in node.output if name and name not in used]
    return _with_outputs(model, ends, nodes)


def _with_outputs(
    model: onnx.ModelProto,
    names: Sequence[str],
    nodes: Sequence[onnx.NodeProto] | None = None,
) -> bytes:
    """The graph, or its first nodes, with these values for outputs."""
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
