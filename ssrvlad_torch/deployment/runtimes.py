"""Runtimes that run an ONNX file as a function of its inputs by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ..files import requiring
from ..segmentation.onnx_files import CPU, open_session
from ..segmentation.onnx_network import OPENVINO
from ..segmentation.openvino_session import SINGLE, OpenVinoSession
from .metadata import Arrays

Run = Callable[[Arrays], dict[str, npt.NDArray[Any]]]
"""Runs a graph: its inputs by name to its outputs by name."""

_RECORD = {"session.record_ep_graph_assignment_info": "1"}


class Runtime(ABC):
    """A runtime for ONNX files.

    Attributes:
        name: name, version, and device or execution provider.
        is_reference: whether other runtimes are compared with it.
        plain: the runtime without the settings that it needs here, as a user may start it; ``None``
            if it needs none.
        needs: these settings in words.
    """

    name: str
    is_reference = False
    plain: Runtime | None = None
    needs = ""

    @abstractmethod
    def open(self, source: Path | bytes) -> Run:
        """A function that runs a file, given by path or content. If this or the function raises
        any error, the runtime cannot run the file."""

    def cpu_fallback(self, source: Path | bytes) -> str:
        """The part of a file that runs on the CPU instead, or ``""``."""
        return ""


def runtime_of(provider: str) -> Runtime:
    """The runtime with a name: an execution provider of ONNX Runtime, or ``"openvino"``. A provider
    that ONNX Runtime lacks is a ValueError, a runtime that is not installed an ImportError."""
    return OpenVino() if provider == OPENVINO else OnnxRuntime(provider)


class OnnxRuntime(Runtime):
    """ONNX Runtime with an execution provider."""

    def __init__(self, provider: str = CPU) -> None:
        with requiring("onnx", "ONNX files need"):
            import onnxruntime
        available = onnxruntime.get_available_providers()
        if provider not in available:
            expected = ", ".join((*available, OPENVINO))
            raise ValueError(f"no execution provider {provider!r}; expected one of {expected}")
        self.name = f"ONNX Runtime {onnxruntime.__version__}, {provider}"
        self.provider, self.is_reference = provider, provider == CPU

    def open(self, source: Path | bytes) -> Run:
        """A function that runs a session."""
        session = open_session(source, "the graph", self.provider)
        names = [output.name for output in session.get_outputs()]
        return lambda inputs: dict(zip(names, session.run(names, dict(inputs)), strict=True))

    def cpu_fallback(self, source: Path | bytes) -> str:
        """The number of nodes that the provider lacks; known from ONNX Runtime 1.24 on."""
        if self.provider == CPU:
            return ""
        session = open_session(source, "the graph", self.provider, settings=_RECORD)
        if not hasattr(session, "get_provider_graph_assignment_info"):
            return "this version of ONNX Runtime does not report which nodes run on the CPU"
        partitions = session.get_provider_graph_assignment_info()
        counts = [(nodes.ep_name, len(nodes.get_nodes())) for nodes in partitions]
        others = sum(count for name, count in counts if name != self.provider)
        total = sum(count for _, count in counts)
        return f"{others} of {total} nodes run on the CPU" if others else ""


class OpenVino(Runtime):
    """OpenVINO's own runtime on the CPU.

    Args:
        settings: of `compile_model`. Without them, OpenVINO computes in bfloat16 on a processor
            that has it.
    """

    needs = f"compile_model(model, 'CPU', {SINGLE})"

    def __init__(self, settings: Mapping[str, str] = SINGLE) -> None:
        with requiring("openvino", "OpenVINO needs"):
            import openvino
        version = openvino.get_version().partition("-")[0]
        precision = ", in single precision" if settings else ", as it is by default"
        self.name = f"OpenVINO {version}, CPU{precision}"
        self.plain = OpenVino({}) if settings else None
        self._settings = dict(settings)

    def open(self, source: Path | bytes) -> Run:
        """A function that runs a compiled model."""
        session = OpenVinoSession(source, "the graph", settings=self._settings)
        names = session.outputs
        return lambda inputs: dict(zip(names, session.run(names, inputs), strict=True))
