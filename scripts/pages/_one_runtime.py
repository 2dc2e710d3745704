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
from typing import Any

import numpy as np

REPETITIONS = 5
_ONLY_FATAL = 4


Run = Callable[[Any], Sequence[Any]]
"""A function of ``(1, H, W)`` labels."""


def opened(runtime: str, file: str) -> tuple[str, list[str], Run]:
    """The name of a runtime with its version, the names of the outputs of a file, and the file as
    a function."""
    if runtime == "openvino":
        import openvino

        core = openvino.Core()
        settings = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
        compiled = core.compile_model(core.read_model(file), "CPU", settings)
        names = [output.get_any_name() for output in compiled.outputs]
        version = openvino.get_version().partition("-")[0]
        title = f"OpenVINO {version}, CPU, single precision"
        return title, names, lambda maps: list(compiled({"labels": maps}).values())
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = _ONLY_FATAL, 1
    session = onnxruntime.InferenceSession(file, options, providers=[runtime])
    if session.get_providers()[0] != runtime:
        raise ValueError(f"there is no {runtime}")
    names = [output.name for output in session.get_outputs()]
    title = f"ONNX Runtime {onnxruntime.__version__}, {runtime}"
    return title, names, lambda maps: session.run(names, {"labels": maps})


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
