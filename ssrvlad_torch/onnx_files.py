"""ONNX files: read with their external weights, written whole or not at all, and run."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from .files import check_output, flush, one_line, replacing
from .untrusted import InputError, check_regular

if TYPE_CHECKING:
    import onnx

LARGEST = (1 << 31) - (1 << 20)
"""Bytes that one file may have: protobuf's limit, and some room for what is not weights."""

CPU = "CPUExecutionProvider"

_EXTERNAL = 1024
_NEEDED = "ONNX files need: pip install ssrvlad-torch[onnx]"
_ONLY_FATAL = 4


def load_model(path: Path) -> onnx.ModelProto:
    """An ONNX file with the weights that lie beside it.

    Raises:
        ValueError: the file is missing or no ONNX graph, or external weights are missing or lie
            outside its folder.
        ImportError: the extra ``onnx`` is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise ImportError(_NEEDED) from error
    try:
        check_regular(path)
        model = onnx.load(path)
    except (InputError, FileNotFoundError) as error:
        raise ValueError(f"{one_line(error)}; expected an ONNX graph") from error
    except Exception as error:  # protobuf's, the checker's and the file system's own types
        raise ValueError(f"{path} cannot be read as an ONNX graph: {one_line(error)}") from error
    if not model.graph.node:
        raise ValueError(f"{path} is no ONNX graph: it has no nodes")
    for tensor in _tensors(model.graph):
        tensor.ClearField("data_location")
    return model


def open_session(
    source: Path | bytes,
    name: object,
    provider: str = CPU,
    otherwise: str | None = None,
    settings: Mapping[str, str] | None = None,
) -> Any:
    """A session of ONNX Runtime.

    Args:
        source: a file, or the content of one.
        name: what messages call it.
        provider: execution provider; what it lacks runs on the CPU.
        otherwise: the provider to take where ONNX Runtime does not have the first.
        settings: entries of the session's configuration.

    Raises:
        ValueError: ONNX Runtime does not have the provider, or cannot run the graph.
        ImportError: the extra ``onnx`` is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError(_NEEDED) from error
    at_hand = onnxruntime.get_available_providers()
    provider = provider if provider in at_hand else otherwise or provider
    if provider not in at_hand:
        raise ValueError(
            f"no execution provider {provider!r}; expected one of {', '.join(at_hand)}"
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ONLY_FATAL
    for key, value in (settings or {}).items():
        options.add_session_config_entry(key, value)
    try:
        return onnxruntime.InferenceSession(source, options, [*dict.fromkeys((provider, CPU))])
    except Exception as error:  # each kind of failure has its own type, not all of them public
        raise ValueError(f"{name} cannot run in ONNX Runtime: {one_line(error)}") from error


def external_files(path: Path) -> list[Path]:
    """The files beside a graph that hold its weights; where there are none, all is in it."""
    try:
        import onnx
    except ImportError as error:
        raise ImportError(_NEEDED) from error
    model = onnx.load(path, load_external_data=False)
    tensors = onnx.external_data_helper._get_all_tensors(model)
    names = {
        entry.value
        for tensor in tensors
        for entry in tensor.external_data
        if entry.key == "location"
    }
    return sorted(path.parent / name for name in names)


def graph_digest(model: onnx.ModelProto) -> str:
    """SHA-256 of a graph, its functions and opsets, in hex; the same wherever its weights lie."""
    digest = hashlib.sha256()
    parts = (*model.opset_import, *model.functions, *_parts(model.graph))
    for part in parts:
        content = part.encode() if isinstance(part, str) else part.SerializeToString(True)
        digest.update(len(content).to_bytes(8, "little") + content)
    return digest.hexdigest()


def save_model(
    model: onnx.ModelProto, path: Path, describe: Callable[[Path], Mapping[str, str]]
) -> None:
    """Writes an ONNX file, whole or not at all.

    Where it would be too large for one file, the weights go to another beside it, whose name
    holds a digest, so that what an earlier file refers to stays as it was.

    Args:
        model: what to write; without its weights afterwards where they went to another file.
        path: the file; what was there is replaced.
        describe: is given the file before it takes its place, and gives the metadata properties
            that it is to have; may reject it by raising.

    Raises:
        OSError: the file cannot be written.
    """
    import onnx

    path = check_output(path)
    with TemporaryDirectory(prefix=f".{path.name}.", dir=path.absolute().parent) as folder:
        staged = Path(folder) / path.name
        weights = f"{path.name}.{graph_digest(model)[:16]}.data"
        if _size(model) > LARGEST:
            onnx.external_data_helper.convert_model_to_external_data(
                model, location=weights, size_threshold=_EXTERNAL
            )
        onnx.save_model(model, staged)
        onnx.helper.set_model_props(model, dict(describe(staged)))
        onnx.save_model(model, staged)
        if (beside := staged.with_name(weights)).exists():
            flush(beside)
            beside.replace(path.with_name(weights))
        with replacing(path) as temporary:
            staged.replace(temporary)


def rename(graph: onnx.GraphProto, new: Callable[[str], str]) -> None:
    """Gives every node and value of a graph, and of those inside it, a new name.

    `onnx.compose.add_prefix` leaves the names that a loop takes from outside as they were.
    """
    for node in graph.node:
        node.name = new(node.name)
        node.input[:] = [name and new(name) for name in node.input]
        node.output[:] = [name and new(name) for name in node.output]
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        value.name = new(value.name)
    for inside in _inside(graph):
        rename(inside, new)


def _size(model: onnx.ModelProto) -> int:
    weights: int = sum(len(tensor.raw_data) for tensor in _tensors(model.graph))
    nodes: int = sum(node.ByteSize() for node in model.graph.node)
    return weights + nodes


def _parts(graph: onnx.GraphProto) -> Iterator[Any]:
    """What a graph is made of, each part small enough to be serialised."""
    for field, value in graph.ListFields():
        yield field.name
        yield from [value] if isinstance(value, str) else value


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    """The weights of a graph and of those inside it."""
    yield from graph.initializer
    for inside in _inside(graph):
        yield from _tensors(inside)


def _inside(graph: onnx.GraphProto) -> Iterator[onnx.GraphProto]:
    """The bodies of loops and branches."""
    for node in graph.node:
        for attribute in node.attribute:
            yield from [attribute.g] if attribute.HasField("g") else attribute.graphs
