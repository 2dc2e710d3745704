"""Where a runtime goes wrong: runtimes that are wrong on purpose, and OpenVINO on wide integers."""

import io
import re
from pathlib import Path

import numpy as np
import onnx
import pytest

from ssrvlad_torch.deployment.diagnosis import diagnose
from ssrvlad_torch.deployment.graph import Graph
from ssrvlad_torch.deployment.runtimes import OnnxRuntime, OpenVino, runtime_of

GIVEN = {"x": np.arange(1, 7)}


def small_graph(prefix: str = "") -> onnx.ModelProto:
    """Three stages, the second with a loop: ``((x + 3) doubled four times) % 7``."""
    graph = Graph({"x": ("int64", ["N"])})
    (x,) = graph.inputs
    if prefix:
        with graph.stage("network"):
            x = x * 1
    with graph.stage(f"{prefix}layers"):
        moved = x + 3
    with graph.stage(f"{prefix}skeleton"):
        (doubled,) = graph.repeat(4, lambda _, state: [state + state], moved)
    with graph.stage(f"{prefix}harmonics"):
        rest = doubled % 7
    return graph.model({"y": (rest, ("int64", ["N"]))})


class Other(OnnxRuntime):
    """ONNX Runtime with another operator in the place of one; without, it refuses the operator."""

    is_reference = False

    def __init__(self, operator: str, other: str = "", says: str = "") -> None:
        super().__init__()
        self.is_reference = False
        self.operator, self.other, self.says = operator, other, says

    def open(self, source):
        model = onnx.load(source if isinstance(source, Path) else io.BytesIO(source))
        for node in self.every(model.graph):
            if node.op_type == self.operator:
                if not self.other:
                    raise RuntimeError(self.says)
                node.op_type = self.other
        return super().open(model.SerializeToString())

    def every(self, graph):
        for node in graph.node:
            yield node
            for attribute in node.attribute:
                yield from self.every(attribute.g)


@pytest.mark.parametrize("prefix", ["", "ssrvlad/"])
def test_the_first_stage_that_differs_is_named(prefix):
    fault = diagnose(small_graph(prefix), GIVEN, Other("Add", "Sub"))
    assert fault[:2] == ("wrong", "layers")
    assert fault.reason.endswith("6 of 6 numbers differ")
    assert diagnose(small_graph(prefix), GIVEN, Other("Mod", "Div")).place == "harmonics"
    if prefix:
        assert diagnose(small_graph(prefix), GIVEN, Other("Mul", "Sub")).place == "network"


def test_what_no_stage_shows_is_the_graph_itself():
    fault = diagnose(small_graph(), GIVEN, Other("Max", "Min"))
    assert fault[:2] == ("wrong", "outputs")


def test_the_node_that_cannot_be_run_is_found_or_read():
    model = small_graph()
    (remainder,) = (node for node in model.graph.node if node.op_type == "Mod")
    fault = diagnose(model, GIVEN, Other("Mod", says="no such kernel"))
    assert fault == ("cannot run", f"{remainder.name} (Mod)", "no such kernel")
    (loop,) = (node for node in model.graph.node if node.op_type == "Loop")
    (inner,) = (node for node in loop.attribute[0].g.node if node.op_type == "Add")
    named = diagnose(model, GIVEN, Other("Mod", says=f"node {inner.name} fails"))
    assert named.place == f"{inner.name} (Add)"


def test_openvino_on_integers_of_64_bits():
    pytest.importorskip("openvino")
    graph = Graph({"x": ("int64", ["N"])})
    with graph.stage("layers"):
        wide = graph.inputs[0] * (1 << 33)
    with graph.stage("skeleton"):
        narrow = wide // (1 << 30)
    model = graph.model({"y": (narrow, ("int64", ["N"]))})
    runtime = runtime_of("openvino")
    assert isinstance(runtime, OpenVino)
    assert runtime.name.startswith("OpenVINO ")
    assert runtime.open(model.SerializeToString())(GIVEN)["y"].tolist() != (8 * GIVEN["x"]).tolist()
    assert diagnose(model, GIVEN, runtime)[:2] == ("wrong", "layers")


def test_what_runs_elsewhere_is_said(tmp_path):
    """The provider for remote services is in every build, and runs nothing of its own."""
    file = tmp_path / "x.onnx"
    onnx.save(small_graph(), file)
    assert OnnxRuntime().cpu_fallback(file) == ""
    runtime = OnnxRuntime("AzureExecutionProvider")
    assert re.fullmatch(r"(\d) of \1 nodes run on the CPU", runtime.cpu_fallback(file))
    assert runtime.open(file)(GIVEN)["y"].tolist() == [(x + 3) * 16 % 7 for x in range(1, 7)]
