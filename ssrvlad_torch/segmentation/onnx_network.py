"""An ONNX graph as a PyTorch module: images in, named outputs out. Needs the extra ``onnx``."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from .network_outputs import Form

_COLOURS = 3
_DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_ONLY_FATAL = 4


class OnnxNetwork(nn.Module):
    """A graph of ONNX Runtime with one image input, on CUDA where the runtime has it.

    Args:
        path: the ``.onnx`` file; external weights lie beside it.

    Attributes:
        size: height and width that the graph takes, ``None`` where it takes any.
        takes_bytes: whether its input is uint8.
        channels_last: whether its input is ``(B, H, W, 3)``, as in graphs that come from TFLite.
        outputs: the form of every output by name, as far as the graph declares it.

    Shape:
        - input: ``(B, 3, H, W)`` float32; turned into the layout, dtype and batches of the graph.
        - output: a mapping of the names that were asked for, or all, to tensors.

    Raises:
        ValueError: the file is missing, no graph that can be run, or takes no image.
        ImportError: the extra ``onnx`` is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self.path = Path(path)
        self._session = _session(self.path)
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            names = ", ".join(given.name for given in inputs)
            raise ValueError(f"{path} has inputs {names}; wanted one, for images")
        self._input: str = inputs[0].name
        shape = _shape(inputs[0])
        form = Form(shape, inputs[0].type, "")
        if shape is None or len(shape) != 4 or inputs[0].type not in _DTYPES:
            raise ValueError(f"{path} takes {form}; wanted (B, 3, H, W) floats or bytes")
        self.channels_last = shape[1] != _COLOURS and shape[3] == _COLOURS
        height, width, channels = shape[1:] if self.channels_last else (*shape[2:], shape[1])
        if channels not in (None, _COLOURS):
            raise ValueError(f"{path} takes {form}; wanted images of 3 channels")
        self.size = (height, width)
        self.takes_bytes = inputs[0].type == "tensor(uint8)"
        self.outputs: Mapping[str, Form] = {
            output.name: Form(_shape(output), output.type, _kind(output.type))
            for output in self._session.get_outputs()
        }
        self._batch = shape[0]
        self._dtype = _DTYPES[inputs[0].type]

    def forward(self, images: Tensor, names: Iterable[str] = ()) -> dict[str, Tensor]:
        """Runs the graph, in batches of its own length if that is fixed."""
        wanted = list(names) or list(self.outputs)
        array = images.numpy(force=True)
        if self.channels_last:
            array = array.transpose(0, 2, 3, 1)
        array = np.ascontiguousarray(array, self._dtype)
        length = self._batch or len(array)
        parts = [self._run(array[i : i + length], wanted) for i in range(0, len(array), length)]
        return {
            name: torch.from_numpy(np.concatenate(arrays))
            for name, arrays in zip(wanted, zip(*parts, strict=True), strict=True)
        }

    def digest(self) -> str:
        """BLAKE2b-128 of the file and of its external weights, in hex."""
        content = hashlib.blake2b(digest_size=16)
        for path in (self.path, *_external_files(self.path)):
            with path.open("rb") as file:
                content.update(hashlib.file_digest(file, "blake2b").digest())
        return content.hexdigest()

    def _run(self, images: npt.NDArray[Any], names: list[str]) -> list[npt.NDArray[Any]]:
        count = len(images)
        if self._batch and count < self._batch:
            filling = np.repeat(images[-1:], self._batch - count, axis=0)
            images = np.concatenate([images, filling])
        return [array[:count] for array in self._session.run(names, {self._input: images})]


def _session(path: Path) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("an ONNX graph needs: pip install ssrvlad-torch[onnx]") from error
    if not path.is_file():
        raise ValueError(f"{path} does not exist or is no file; wanted an ONNX graph")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ONLY_FATAL
    at_hand = onnxruntime.get_available_providers()
    wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
    providers = [provider for provider in wanted if provider in at_hand]
    try:
        return onnxruntime.InferenceSession(path, options, providers=providers)
    except Exception as error:  # each kind of failure has its own type, not all of them public
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} is no ONNX graph that can be run: {reason}") from error


def _shape(value: Any) -> tuple[int | None, ...] | None:
    """Lengths of the axes; ONNX Runtime gives names for free ones, and none for a free rank."""
    if not value.shape:
        return None
    return tuple(n if isinstance(n, int) and n > 0 else None for n in value.shape)


def _kind(dtype: str) -> str:
    if dtype in ("tensor(float)", "tensor(float16)", "tensor(double)"):
        return "scores"
    return "ids" if dtype.startswith(("tensor(int", "tensor(uint")) else ""


def _external_files(path: Path) -> list[Path]:
    """The files beside a graph that hold its weights; where there are none, all is in it."""
    try:
        import onnx
    except ImportError as error:
        raise ImportError("an ONNX graph needs: pip install ssrvlad-torch[onnx]") from error
    return sorted(
        path.parent / name for name in _locations(onnx.load(path, load_external_data=False))
    )


def _locations(message: Any) -> set[str]:
    """Where the tensors of a protobuf message lie, those of subgraphs and functions among them."""
    if hasattr(message, "external_data"):
        return {entry.value for entry in message.external_data if entry.key == "location"}
    found: set[str] = set()
    for field, value in message.ListFields():
        if field.message_type is not None:
            for part in [value] if hasattr(value, "ListFields") else value:
                found |= _locations(part)
    return found
