"""An ONNX graph as a PyTorch module: images in, named outputs out. Needs the extra ``onnx``, and
``openvino`` for that runtime."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .onnx_files import CPU, OpenVinoSession, external_files, open_session

_DTYPES = {
    "tensor(float)": torch.float32,
    "tensor(float16)": torch.float16,
    "tensor(double)": torch.float64,
    "tensor(uint8)": torch.uint8,
}

RUNTIMES = ONNX_RUNTIME, OPENVINO = "onnxruntime", "openvino"
"""What runs a graph."""

CUDA = "CUDAExecutionProvider"


class OnnxNetwork(nn.Module):
    """A graph with one image input: in ONNX Runtime, on CUDA if it supports that, or in OpenVINO on
    the CPU, in single precision. Images ``(B, 3, H, W)`` float give a mapping of names to tensors.
    A file that cannot be run or takes no image is a ValueError; a missing extra is an ImportError.

    Attributes:
        size: height and width of the input, ``None`` for a free side.
        dtype, channels_last: of the input; its layout is ``(B, H, W, 3)`` or ``(B, 3, H, W)``.
        outputs: the names of the outputs.
        digest: BLAKE2b-128 of the file and of its external weights, in hex.
        metadata: the metadata properties of the file.
    """

    def __init__(self, path: str | Path, runtime: str = ONNX_RUNTIME) -> None:
        super().__init__()
        self.path, self.runtime = Path(path), runtime
        if not self.path.is_file():
            raise ValueError(f"{path} does not exist or is not a file; expected an ONNX graph")
        self._session: Any = open_session(self.path, path, CUDA, threads=torch.get_num_threads())
        self.digest = self._digest()
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            names = ", ".join(value.name for value in inputs)
            raise ValueError(f"{path} has inputs {names}; expected one, for images")
        self.input, form = inputs[0].name, f"{tuple(inputs[0].shape)} {inputs[0].type}"
        shape = [n if isinstance(n, int) and n > 0 else None for n in inputs[0].shape]
        if len(shape) != 4 or inputs[0].type not in _DTYPES:
            raise ValueError(f"{path} takes {form}; expected (B, 3, H, W) floats or bytes")
        self.dtype, self.channels_last = _DTYPES[inputs[0].type], shape[1] != 3 and shape[3] == 3
        self.batch, *sides = shape
        channels = sides.pop(2 if self.channels_last else 0)
        if channels not in (None, 3):
            raise ValueError(f"{path} takes {form}; expected images of 3 channels")
        self.size = sides[0], sides[1]
        self.outputs: list[str] = [output.name for output in self._session.get_outputs()]
        self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
        if runtime == OPENVINO:
            self.take([])

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the path: another process opens the file again."""
        return OnnxNetwork, (self.path.absolute(), self.runtime)

    def forward(self, images: Tensor, names: Iterable[str] = ()) -> dict[str, Tensor]:
        """Runs the graph, in batches of the length that it declares, if it declares one."""
        names = list(names) or self.outputs
        array = np.ascontiguousarray(self.fed(images).numpy(force=True))
        length = self.batch or len(array)
        missing = -len(array) % length
        padded = np.concatenate([array, array[-1:].repeat(missing, axis=0)]) if missing else array
        batches = (padded[first : first + length] for first in range(0, len(padded), length))
        runs = [self._session.run(names, {self.input: batch}) for batch in batches]
        outputs = {}
        for name, arrays in zip(names, zip(*runs, strict=True), strict=True):
            # ids (h, w) of a graph of one picture have no axis for the batch
            single = len(arrays) > 1 and length == 1 and arrays[0].ndim == 2 and len(arrays[0]) > 1
            joined = torch.from_numpy((np.stack if single else np.concatenate)(arrays))
            outputs[name] = joined[: len(array)] if missing else joined
        return outputs

    def fed(self, images: Tensor) -> Tensor:
        """The input of the graph for images ``(B, 3, H, W)``, in its layout and dtype."""
        if self.dtype == torch.uint8:
            images = images.round().clamp(0, 255)
        if self.channels_last:
            images = images.permute(0, 2, 3, 1)
        return images.to(self.dtype)

    def take(self, names: Sequence[str]) -> None:
        """Makes inner tensors outputs; a ValueError if the graph cannot run with them."""
        if self.runtime == OPENVINO:
            self._require_unchanged()
            threads = torch.get_num_threads()
            self._session = OpenVinoSession(self.path, self.path, names, threads)
        else:
            self._session = self._session_with(names, CUDA)

    def run_all(self, images: Tensor) -> dict[str, Tensor]:
        """The inner tensors for one picture by name, in the order in which they are computed, by
        ONNX Runtime on the CPU."""
        array = np.ascontiguousarray(self.fed(images).numpy(force=True))
        if self.batch:
            array = np.repeat(array, self.batch, axis=0)
        session = self._session_with(None, CPU)
        names = [output.name for output in session.get_outputs()][len(self.outputs) :]
        values = session.run(names, {self.input: array})
        return {
            name: torch.from_numpy(value)
            for name, value in zip(names, values, strict=True)
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiub"
        }

    def class_names(self) -> dict[int, str]:
        """Names of its classes by channel, which exporters write in JSON into the metadata."""
        keys = ("id2label", "names", "classes", "class_names")
        text = next((self.metadata[key] for key in keys if key in self.metadata), "{}")
        try:
            names = json.loads(text)
            names = dict(enumerate(names)) if isinstance(names, list) else names
            return {int(number): str(name) for number, name in names.items()}
        except (AttributeError, TypeError, ValueError, RecursionError):
            return {}

    def _session_with(self, names: Sequence[str] | None, provider: str) -> Any:
        """A session with inner tensors, or all of them, as further outputs."""
        import onnx

        self._require_unchanged()
        model = onnx.load(self.path, load_external_data=False)
        if names is None:
            computed = (name for node in model.graph.node for name in node.output)
            names = [name for name in computed if name and name not in self.outputs]
        model.graph.output.extend(map(onnx.helper.make_empty_tensor_value_info, names))
        settings = {"session.model_external_initializers_file_folder_path": str(self.path.parent)}
        content, threads = model.SerializeToString(), torch.get_num_threads()
        return open_session(content, self.path, provider, settings, threads)

    def _require_unchanged(self) -> None:
        """Refuses files that are no longer those of the session."""
        if not self.path.is_file() or self._digest() != self.digest:
            raise ValueError(f"{self.path} has changed or is gone: open it again")

    def _digest(self) -> str:
        content = hashlib.blake2b(digest_size=16)
        for path in (self.path, *external_files(self.path)):
            with path.open("rb") as file:
                content.update(hashlib.file_digest(file, "blake2b").digest())
        return content.hexdigest()
