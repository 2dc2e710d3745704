"""ONNX files: reading with external weights, sessions of ONNX Runtime and of OpenVINO."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..files import (
    InputError,
    check_regular,
    naming,
    one_line,
    path_within,
    requiring,
)

if TYPE_CHECKING:
    import onnx


CPU = "CPUExecutionProvider"
_APART = "External data path"
"""In the messages of ONNX Runtime about a missing file of weights."""


def load_model(path: Path) -> onnx.ModelProto:
    """The model in an ONNX file, with its external weights; both may be links. A missing file, no
    ONNX graph, and weights that are missing or outside its folder are a ValueError; without the
    extra ``onnx``, an ImportError."""
    with requiring("onnx", "ONNX files need"):
        import onnx
    try:
        check_regular(path)
        model = onnx.load(path, load_external_data=False)
        for tensor, entries in _external(model):
            tensor.raw_data = _external_bytes(path.parent, tensor.name, entries)
            del tensor.external_data[:]
            tensor.ClearField("data_location")
    except InputError:
        raise
    except FileNotFoundError as error:
        raise ValueError(f"{error.filename} does not exist; expected an ONNX graph") from error
    except Exception as error:  # protobuf's, the checker's and the file system's own types
        raise ValueError(f"{path} cannot be read as an ONNX graph: {one_line(error)}") from error
    if not model.graph.node:
        raise ValueError(f"{path} is not an ONNX graph: it has no nodes")
    return model


def _external(model: onnx.ModelProto) -> Iterator[tuple[onnx.TensorProto, dict[str, str]]]:
    """The tensors of a model whose weights are in other files, and where they are."""
    from onnx.external_data_helper import _get_all_tensors, uses_external_data

    for tensor in filter(uses_external_data, _get_all_tensors(model)):
        yield tensor, {entry.key: entry.value for entry in tensor.external_data}


def _external_bytes(folder: Path, name: str, entries: Mapping[str, str]) -> bytes:
    """The weights of a tensor in a file in a folder. `onnx.load` refuses links."""
    path, length = path_within(folder, entries["location"]), entries.get("length")
    check_regular(path)
    with path.open("rb") as file:
        file.seek(int(entries.get("offset", 0)))
        content = file.read(int(length) if length else -1)
    if length and len(content) != int(length):
        raise InputError(f"{path} ends before the weights {name!r}")
    return content


def open_session(
    source: Path | bytes,
    name: object,
    provider: str = CPU,
    settings: Mapping[str, str] | None = None,
    threads: int = 0,
) -> Any:
    """A session of ONNX Runtime for a file or its content, ``name`` in messages, with configuration
    entries and threads for an operator, 0 for one per core. A graph that cannot run is a
    ValueError; without the extra ``onnx``, an ImportError."""
    with requiring("onnx", "ONNX files need"):
        import onnxruntime
    available = onnxruntime.get_available_providers()
    providers = [name for name in dict.fromkeys((provider, CPU)) if name in available]
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # only what is fatal
    options.intra_op_num_threads = threads
    for key, value in (settings or {}).items():
        options.add_session_config_entry(key, value)
    try:
        return onnxruntime.InferenceSession(source, options, providers)
    except Exception as error:  # each kind of failure has its own type, and not all are public
        text = one_line(error)
        hint = "; the file and that of its weights belong together" if _APART in text else ""
        raise ValueError(f"{name} cannot run in ONNX Runtime: {text}{hint}") from error


def external_files(path: Path) -> list[Path]:
    """The files that hold the external weights of an ONNX file, sorted; often none. A name that
    leaves the folder is an InputError; without the extra ``onnx``, an ImportError."""
    with requiring("onnx", "ONNX files need"):
        import onnx
    model = onnx.load(path, load_external_data=False)
    names = set[str]()
    for tensor, entries in _external(model):
        if "location" not in entries:
            raise InputError(f"{path}: the weights {tensor.name!r} are in a file without a name")
        names.add(entries["location"])
    return sorted(path_within(path.parent, name) for name in names)


SINGLE = {"INFERENCE_PRECISION_HINT": "f32"}
"""The settings for single precision: OpenVINO computes in bfloat16 on a processor that has it."""


class OpenVinoSession:
    """A graph, a file or its content, that OpenVINO compiled for the CPU; ``name`` is for messages.
    ``inner`` tensors become outputs; ``outputs`` are the names of all. Threads may run it together,
    each with ``threads``, 0 for one per core. One that cannot run is a ValueError."""

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
