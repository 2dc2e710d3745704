"""Runtimes: what runs an ONNX file, as a function of its inputs by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..onnx_files import CPU, open_session

Arrays = Mapping[str, npt.NDArray[Any]]
Run = Callable[[Arrays], dict[str, npt.NDArray[Any]]]
"""The outputs of a graph by name, of its inputs by name."""

OPENVINO = "openvino"
"""The name of OpenVINO's own runtime; other names are execution providers of ONNX Runtime."""

_RECORD = {"session.record_ep_graph_assignment_info": "1"}


class Runtime(Protocol):
    """What runs ONNX files.

    Attributes:
        name: with its version, and the device or the execution provider.
        is_reference: whether it is the one that others are compared with.
    """

    name: str
    is_reference: bool

    def open(self, source: Path | bytes) -> Run:
        """A function of a file or of its content. Whatever this or the function raises, the
        runtime cannot run the file."""

    def elsewhere(self, source: Path | bytes) -> str:
        """Which part of a file it leaves to the CPU, or ``""``."""


def runtime_of(provider: str) -> Runtime:
    """The runtime of a name: an execution provider of ONNX Runtime, or ``"openvino"``.

    Raises:
        ImportError: it is not installed.
    """
    return OpenVino() if provider == OPENVINO else OnnxRuntime(provider)


class OnnxRuntime:
    """ONNX Runtime with an execution provider."""

    def __init__(self, provider: str = CPU) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError("ONNX files need: pip install ssrvlad-torch[onnx]") from error
        at_hand = onnxruntime.get_available_providers()
        if provider not in at_hand:
            expected = ", ".join((*at_hand, OPENVINO))
            raise ValueError(f"no execution provider {provider!r}; expected one of {expected}")
        self.name = f"ONNX Runtime {onnxruntime.__version__}, {provider}"
        self.provider, self.is_reference = provider, provider == CPU

    def open(self, source: Path | bytes) -> Run:
        """A session as a function."""
        session = open_session(source, "the graph", self.provider)
        names = [output.name for output in session.get_outputs()]
        return lambda given: dict(zip(names, session.run(names, dict(given)), strict=True))

    def elsewhere(self, source: Path | bytes) -> str:
        """ONNX Runtime gives the CPU the nodes that a provider lacks; it tells from 1.24 on."""
        if self.provider == CPU:
            return ""
        session = open_session(source, "the graph", self.provider, settings=_RECORD)
        if not hasattr(session, "get_provider_graph_assignment_info"):
            return "this version of ONNX Runtime does not tell which nodes run on the CPU"
        parts = session.get_provider_graph_assignment_info()
        counts = [(part.ep_name, len(part.get_nodes())) for part in parts]
        others = sum(count for name, count in counts if name != self.provider)
        total = sum(count for _, count in counts)
        return f"{others} of {total} nodes run on the CPU" if others else ""


class OpenVino:
    """OpenVINO's own runtime on the CPU, in single precision."""

    def __init__(self) -> None:
        try:
            import openvino
        except ImportError as error:
            raise ImportError("OpenVINO needs: pip install openvino") from error
        version = openvino.get_version().partition("-")[0]
        self.name, self.is_reference = f"OpenVINO {version}, CPU", False
        self._core = openvino.Core()

    def open(self, source: Path | bytes) -> Run:
        """A compiled model as a function."""
        model = self._core.read_model(source)
        names = [output.get_any_name() for output in model.outputs]
        compiled = self._core.compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})

        def run(given: Arrays) -> dict[str, npt.NDArray[Any]]:
            found = compiled(dict(given))
            return {name: np.array(found[place]) for place, name in enumerate(names)}

        return run

    def elsewhere(self, source: Path | bytes) -> str:
        """Nothing: it refuses what it lacks."""
        return ""
