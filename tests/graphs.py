"""Sessions of ONNX Runtime, and exported files with another golden pair; shared by the tests."""

import base64
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import pytest


def session(content: bytes, **options: Any) -> onnxruntime.InferenceSession:
    """A session with one thread on the CPU, without warnings."""
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    settings.log_severity_level = 3
    for name, value in options.items():
        setattr(settings, name, value)
    return onnxruntime.InferenceSession(content, settings, ["CPUExecutionProvider"])


def in_onnxruntime(model: onnx.ModelProto) -> Callable[..., list[Any]]:
    """A model as a function of its inputs in order."""
    runner = session(model.SerializeToString())
    names = [value.name for value in runner.get_inputs()]
    return lambda *inputs: runner.run(None, dict(zip(names, inputs, strict=True)))


def in_openvino(model: onnx.ModelProto) -> Callable[..., list[Any]]:
    """The same in OpenVINO, in single precision."""
    openvino = pytest.importorskip("openvino", reason="the extra openvino is not installed")
    core = openvino.Core()
    read = core.read_model(model.SerializeToString())
    compiled = core.compile_model(read, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    names = [value.name for value in model.graph.input]
    return lambda *inputs: list(compiled(dict(zip(names, inputs, strict=True))).values())


by_runtime = pytest.mark.parametrize("runtime", [in_onnxruntime, in_openvino])


def edit_golden(source: Path, target: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A copy of an exported file with another golden pair."""
    model = onnx.load(source)
    (entry,) = (prop for prop in model.metadata_props if prop.key == "ssrvlad.golden")
    golden = json.loads(entry.value)
    change(golden)
    entry.value = json.dumps(golden)
    onnx.save(model, target)
    return target


def without_property(source: Path, target: Path, name: str) -> Path:
    """A copy of an exported file without one of its properties ``ssrvlad.*``."""
    model = onnx.load(source)
    (entry,) = (prop for prop in model.metadata_props if prop.key == f"ssrvlad.{name}")
    model.metadata_props.remove(entry)
    onnx.save(model, target)
    return target


def turned(name: str) -> Callable[[dict[str, Any]], None]:
    """For `edit_golden`: reverses the bytes of an array, so that a correct runtime looks wrong."""

    def turn(golden: dict[str, Any]) -> None:
        content = zlib.decompress(base64.b64decode(golden[name]["data"]))
        golden[name]["data"] = base64.b64encode(zlib.compress(content[::-1])).decode()

    return turn
