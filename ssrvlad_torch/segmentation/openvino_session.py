"""OpenVINO on the CPU in the place of a session of ONNX Runtime. Needs the extra ``openvino``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import naming, requiring
from .onnx_files import external_files, load_model

SINGLE = {"INFERENCE_PRECISION_HINT": "f32"}
"""The settings for single precision: OpenVINO computes in bfloat16 on a processor that has it."""


class OpenVinoSession:
    """A graph, by its file or its content, that OpenVINO has compiled for the CPU; ``name`` is that
    of the file in messages. The ``inner`` tensors become outputs; ``outputs`` are the names of all.
    Threads may run it at the same time, each with ``threads`` of its own, 0 for one per core. One
    that cannot run, or has no such tensor, is a ValueError; without the extra ``openvino``, an
    ImportError."""

    def __init__(
        self, source: Path | bytes, name: object, inner: Sequence[str] = (), threads: int = 0
    ) -> None:
        with requiring("openvino", "OpenVINO needs"):
            import openvino
        core = openvino.Core()
        limits = {"INFERENCE_NUM_THREADS": threads} if threads else {}
        with naming(f"{name} cannot run in OpenVINO"):
            if isinstance(source, Path) and any(f.is_symlink() for f in external_files(source)):
                source = load_model(source).SerializeToString()  # OpenVINO refuses links
            model = core.read_model(source)
            model.add_outputs([*inner])
            self._compiled = core.compile_model(model, "CPU", {**SINGLE, **limits})
        self._numbers = {
            name: number for number, output in enumerate(model.outputs) for name in output.names
        }
        self.outputs = [output.get_any_name() for output in model.outputs]

    def run(
        self, names: Sequence[str], inputs: Mapping[str, npt.NDArray[Any]]
    ) -> list[npt.NDArray[Any]]:
        """The outputs with these names."""
        request = self._compiled.create_infer_request()
        results = request.infer(dict(inputs))
        return [np.array(results[self._numbers[name]]) for name in names]
