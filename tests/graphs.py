"""Runs parts of the method as graphs on tensors in ONNX Runtime; shared by the tests."""

import base64
import json
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import torch
from torch import Tensor

from ssrvlad_torch.deployment.graph import Graph, Symbol
from ssrvlad_torch.deployment.words import PIXELS, Words, grid_of

Build = Callable[..., Sequence[Symbol | Words]]
_SHIFTS = 8 * torch.arange(PIXELS)

Forms = tuple[tuple[str, int], ...]


def session(content: bytes, **options: Any) -> onnxruntime.InferenceSession:
    """A session with one thread on the CPU, without warnings."""
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    settings.log_severity_level = 3
    for name, value in options.items():
        setattr(settings, name, value)
    return onnxruntime.InferenceSession(content, settings, ["CPUExecutionProvider"])


def run(build: Build, *given: Tensor | int) -> list[Tensor]:
    """The outputs of ``build(graph, *symbols)`` for these tensors; each graph is built once.

    int32 of a graph is int64 here.
    """
    return [result for result, _ in _results(build, given)]


def run_on_planes(build: Build, planes: Tensor, *given: Tensor | int) -> list[Tensor]:
    """`run` for ``build(graph, words, *symbols)``: bit-planes go in as words, and outputs of words
    come back as bit-planes."""
    shape = planes.shape
    results = _results(_with_words(build), (to_line(planes), torch.tensor(shape), *given))
    return [to_planes(result, shape) if is_words else result for result, is_words in results]


def to_line(planes: Tensor) -> Tensor:
    """``(B, H, W)`` bit-planes -> the line of `words.Words`."""
    count, height, width = planes.shape
    rows = torch.zeros(count, height + 1, (width // PIXELS + 1) * PIXELS, dtype=torch.int64)
    rows[:, :height, :width] = planes
    return (rows.view(-1, PIXELS) << _SHIFTS).sum(1)


def to_planes(line: Tensor, shape: Sequence[int]) -> Tensor:
    """The inverse of `to_line`; the margins must be background."""
    count, height, width = shape
    rows = (line[:, None] >> _SHIFTS & 255).view(count, height + 1, -1)
    planes = rows[:, :height, :width].to(torch.uint8)
    assert torch.equal(to_line(planes), line), "pixels in the margins"
    return planes


def edit_golden(source: Path, target: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A copy of an exported file with another golden pair."""
    model = onnx.load(source)
    (entry,) = (each for each in model.metadata_props if each.key == "ssrvlad.golden")
    golden = json.loads(entry.value)
    change(golden)
    entry.value = json.dumps(golden)
    onnx.save(model, target)
    return target


def turned(name: str) -> Callable[[dict[str, Any]], None]:
    """For `edit_golden`: reverses the bytes of an array, so that a correct runtime looks wrong."""

    def turn(golden: dict[str, Any]) -> None:
        content = zlib.decompress(base64.b64decode(golden[name]["data"]))
        golden[name]["data"] = base64.b64encode(zlib.compress(content[::-1])).decode()

    return turn


@cache
def _with_words(build: Build) -> Build:
    def with_words(
        graph: Graph, line: Symbol, shape: Symbol, *more: Symbol
    ) -> Sequence[Symbol | Words]:
        return build(graph, Words(line, grid_of(shape[0], shape[1], shape[2])), *more)

    return with_words


def _results(build: Build, given: Sequence[Tensor | int]) -> list[tuple[Tensor, bool]]:
    """Every result, and whether it is a line of words."""
    arrays = [_narrow(np.asarray(each)) for each in given]
    session, are_words = _session(build, tuple((array.dtype.name, array.ndim) for array in arrays))
    used = {node.name for node in session.get_inputs()}
    fed = {f"in_{number}": array for number, array in enumerate(arrays)}
    found = session.run(None, {name: array for name, array in fed.items() if name in used})
    results = zip(found[::2], found[1::2], are_words, strict=True)
    return [(_wide(flat.reshape(shape)), is_words) for flat, shape, is_words in results]


def _narrow(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    fits = array.dtype == np.int64 and np.array_equal(array, array.astype(np.int32))
    return array.astype(np.int32) if fits else array


def _wide(array: npt.NDArray[Any]) -> Tensor:
    return torch.from_numpy(array.astype(np.int64) if array.dtype == np.int32 else array)


@cache
def _session(build: Build, forms: Forms) -> tuple[onnxruntime.InferenceSession, list[bool]]:
    graph = Graph(
        {
            f"in_{number}": (dtype, [f"n_{number}_{axis}" for axis in range(rank)])
            for number, (dtype, rank) in enumerate(forms)
        }
    )
    outputs, results = {}, build(graph, *graph.inputs)
    for number, result in enumerate(results):
        symbol = result.line if isinstance(result, Words) else result
        outputs[f"out_{number}"] = (symbol.reshape(-1), (symbol.dtype, [f"m_{number}"]))
        outputs[f"shape_{number}"] = (graph.Shape(symbol), ("int64", [f"r_{number}"]))
    are_words = [isinstance(result, Words) for result in results]
    return session(graph.model(outputs).SerializeToString()), are_words
