"""Runs an exported file on label maps, on one thread; needs numpy and onnxruntime or openvino.

python _one_runtime.py RUNTIME FILE MAPS.npz OUT.npz

RUNTIME is an execution provider of ONNX Runtime, or openvino. OUT.npz has what the file gives for
each map, ``NUMBER OUTPUT``, and the runtime's ``name``, ``load`` and ``taken`` for the last map in
seconds.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

REPETITIONS = 5
_ONLY_FATAL = 4


class Opened(NamedTuple):
    """A runtime with its version, names of the outputs, and a function of ``(1, H, W)`` labels."""

    name: str
    outputs: Sequence[str]
    run: Callable[[Any], Sequence[Any]]


def opened(runtime: str, file: str) -> Opened:
    """A file on a runtime."""
    return _in_openvino(file) if runtime == "openvino" else _in_onnxruntime(runtime, file)


def _in_openvino(file: str) -> Opened:
    import openvino

    core = openvino.Core()
    settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    compiled = core.compile_model(core.read_model(file), "CPU", settings)
    names = [output.get_any_name() for output in compiled.outputs]
    version = openvino.get_version().partition("-")[0]
    return Opened(
        f"OpenVINO {version}, CPU, single precision",
        names,
        lambda maps: list(compiled({"labels": maps}).values()),
    )


def _in_onnxruntime(provider: str, file: str) -> Opened:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = _ONLY_FATAL, 1
    session = onnxruntime.InferenceSession(file, options, providers=[provider])
    if session.get_providers()[0] != provider:
        raise ValueError(f"there is no {provider}")
    names = [output.name for output in session.get_outputs()]
    return Opened(
        f"ONNX Runtime {onnxruntime.__version__}, {provider}",
        names,
        lambda maps: session.run(names, {"labels": maps}),
    )


def main() -> None:
    """The command line."""
    runtime, file, maps, out = sys.argv[1:]
    begin = time.perf_counter()
    name, names, run = opened(runtime, file)
    found = {"name": np.array(name), "load": np.array(time.perf_counter() - begin)}
    with np.load(maps) as given:
        for number in given.files:
            labels = given[number][None]
            outputs = zip(names, run(labels), strict=True)
            found |= {f"{number} {output}": np.asarray(array) for output, array in outputs}
    taken = []
    for _ in range(REPETITIONS):
        begin = time.perf_counter()
        run(labels)
        taken.append(time.perf_counter() - begin)
    np.savez(out, taken=np.array(statistics.median(taken)), **found)


if __name__ == "__main__":
    main()
