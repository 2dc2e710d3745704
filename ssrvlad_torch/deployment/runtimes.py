"""Runtimes that run an ONNX file as a function of its inputs by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy.typing as npt

from ..files import requiring
from ..segmentation.onnx_files import CPU, OpenVinoSession, open_session
from ..segmentation.onnx_network import OPENVINO
from .metadata import Arrays

Run = Callable[[Arrays], dict[str, npt.NDArray[Any]]]
"""Runs a graph: its inputs by name to its outputs by name."""


class Runtime(NamedTuple):
    """A runtime for ONNX files: its name, version and device, and what opens a file, by path or
    content. What either raises means that it cannot run it."""

    name: str
    open: Callable[[Path | bytes], Run]


def runtime_of(provider: str = CPU) -> Runtime:
    """The runtime with a name: an execution provider of ONNX Runtime, or ``"openvino"``. A provider
    that ONNX Runtime lacks is a ValueError, a runtime that is not installed an ImportError."""
    if provider == OPENVINO:
        with requiring("openvino", "OpenVINO needs"):
            import openvino
        version = openvino.get_version().partition("-")[0]
        return Runtime(f"OpenVINO {version}, CPU, in single precision", _compiled)
    with requiring("onnx", "ONNX files need"):
        import onnxruntime
    available = onnxruntime.get_available_providers()
    if provider not in available:
        expected = ", ".join((*available, OPENVINO))
        raise ValueError(f"no execution provider {provider!r}; expected one of {expected}")

    def open_graph(source: Path | bytes) -> Run:
        session = open_session(source, "the graph", provider)
        return _by_name(session, [output.name for output in session.get_outputs()])

    return Runtime(f"ONNX Runtime {onnxruntime.__version__}, {provider}", open_graph)


def _compiled(source: Path | bytes) -> Run:
    session = OpenVinoSession(source, "the graph")
    return _by_name(session, session.outputs)


def _by_name(session: Any, names: list[str]) -> Run:
    return lambda inputs: dict(zip(names, session.run(names, dict(inputs)), strict=True))
