"""An ONNX graph as a PyTorch module: images in, named outputs out. Needs the extra ``onnx``, and
``openvino`` for that runtime."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from .network_outputs import OutputForm
from .onnx_files import CPU, external_files, open_session
from .openvino_session import OpenVinoSession
from .preparation import InputForm

if TYPE_CHECKING:
    import onnx

_FLOATS = {
    "tensor(float)": torch.float32,
    "tensor(float16)": torch.float16,
    "tensor(double)": torch.float64,
}
_DTYPES = {**_FLOATS, "tensor(uint8)": torch.uint8}

RUNTIMES = ONNX_RUNTIME, OPENVINO = "onnxruntime", "openvino"
"""What runs a graph."""

CUDA = "CUDAExecutionProvider"


class OnnxNetwork(nn.Module):
    """A graph with one image input: in ONNX Runtime, on CUDA if it supports that, or in OpenVINO on
    the CPU, in single precision.

    Args:
        path: the ``.onnx`` file; external weights lie beside it.
        runtime: one of `RUNTIMES`.

    Attributes:
        size: height and width of the input, ``None`` for a free side.
        form: dtype and layout of the input.
        outputs: the form of every output by name, as far as the graph declares it.
        digest: BLAKE2b-128 of the file and of its external weights, in hex.
        metadata: the metadata properties of the file.

    Shape:
        - input: ``(B, 3, H, W)`` or ``(B, H, W, 3)`` in the form of the graph.
        - output: a mapping of the requested names, or all, to tensors.

    Raises:
        ValueError: the file is missing, cannot be run, or does not take one image input.
        ImportError: an extra is not installed.
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
        self.input: str = inputs[0].name
        shape = _shape(inputs[0])
        form = OutputForm(shape, inputs[0].type, "")
        if shape is None or len(shape) != 4 or inputs[0].type not in _DTYPES:
            raise ValueError(f"{path} takes {form}; expected (B, 3, H, W) floats or bytes")
        last = shape[1] != 3 and shape[3] == 3
        height, width, channels = shape[1:] if last else (*shape[2:], shape[1])
        if channels not in (None, 3):
            raise ValueError(f"{path} takes {form}; expected images of 3 channels")
        self.size = (height, width)
        self.form = InputForm(_DTYPES[inputs[0].type], last)
        self.batch = shape[0]
        self.outputs: dict[str, OutputForm] = {}
        for output in self._session.get_outputs():
            kind = "ids" if output.type.startswith(("tensor(int", "tensor(uint")) else ""
            kind = "scores" if output.type in _FLOATS else kind
            self.outputs[output.name] = OutputForm(_shape(output), output.type, kind)
        self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
        if runtime == OPENVINO:
            self._session = self._in_openvino()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles the path: another process opens the file again."""
        return OnnxNetwork, (self.path.absolute(), self.runtime)

    def forward(self, images: Tensor, names: Iterable[str] = ()) -> dict[str, Tensor]:
        """Runs the graph, in batches of the length that it declares, if it declares one."""
        names = list(names) or list(self.outputs)
        array = np.ascontiguousarray(images.numpy(force=True))
        length = self.batch or len(array)
        parts = [self._run(array[i : i + length], names) for i in range(0, len(array), length)]
        return {
            name: torch.from_numpy(np.concatenate(arrays))
            for name, arrays in zip(names, zip(*parts, strict=True), strict=True)
        }

    def take(self, names: Sequence[str]) -> None:
        """Makes inner tensors outputs; a ValueError if the graph cannot run with them."""
        if self.runtime == OPENVINO:
            self._require_unchanged()
            self._session = self._in_openvino(names)
        else:
            self._session = self._session_with(self._model(), names)

    def run_all(self, images: Tensor) -> dict[str, Tensor]:
        """The inner tensors of numbers for one picture by name, in the order in which they are
        computed, by ONNX Runtime on the CPU."""
        model = self._model()
        names = [name for node in model.graph.node for name in node.output]
        names = [name for name in names if name and name not in self.outputs]
        session, array = self._session_with(model, names, CPU), images.numpy(force=True)
        if self.batch:
            array = np.repeat(array, self.batch, axis=0)
        values = session.run(names, {self.input: np.ascontiguousarray(array)})
        return {
            name: torch.from_numpy(value)
            for name, value in zip(names, values, strict=True)
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiub"
        }

    def _require_unchanged(self) -> None:
        """Refuses files that are no longer those of the session."""
        if not self.path.is_file() or self._digest() != self.digest:
            raise ValueError(f"{self.path} has changed or is gone: open it again")

    def _model(self) -> onnx.ModelProto:
        import onnx

        self._require_unchanged()
        return onnx.load(self.path, load_external_data=False)

    def _session_with(
        self, model: onnx.ModelProto, names: Sequence[str], provider: str = CUDA
    ) -> Any:
        from onnx.helper import make_empty_tensor_value_info

        model.graph.output.extend(map(make_empty_tensor_value_info, names))
        settings = {"session.model_external_initializers_file_folder_path": str(self.path.parent)}
        content, threads = model.SerializeToString(), torch.get_num_threads()
        return open_session(content, self.path, provider, settings, threads)

    def _in_openvino(self, names: Sequence[str] = ()) -> OpenVinoSession:
        return OpenVinoSession(self.path, self.path, names, threads=torch.get_num_threads())

    def class_names(self) -> dict[int, str]:
        """Names of its classes by channel, from the metadata that exporters write: a mapping or a
        list, in JSON or as a Python literal, as of Ultralytics. Others are empty."""
        keys = ("id2label", "names", "classes", "class_names")
        text = next((self.metadata[key] for key in keys if key in self.metadata), "")
        names: Any = {}
        for parse in (json.loads, ast.literal_eval):
            with suppress(ValueError, SyntaxError, RecursionError, MemoryError):
                names = parse(text)
                break
        if isinstance(names, list):
            names = dict(enumerate(names))
        try:
            return {int(n): str(name) for n, name in names.items()}
        except (AttributeError, TypeError, ValueError):
            return {}

    def _digest(self) -> str:
        content = hashlib.blake2b(digest_size=16)
        for path in (self.path, *external_files(self.path)):
            with path.open("rb") as file:
                content.update(hashlib.file_digest(file, "blake2b").digest())
        return content.hexdigest()

    def _run(self, images: npt.NDArray[Any], names: list[str]) -> list[npt.NDArray[Any]]:
        count = len(images)
        if self.batch and count < self.batch:
            filling = np.repeat(images[-1:], self.batch - count, axis=0)
            images = np.concatenate([images, filling])
        return [array[:count] for array in self._session.run(names, {self.input: images})]


def _shape(value: Any) -> tuple[int | None, ...] | None:
    """Lengths of the axes, ``None`` for free ones; ``None`` if the rank is free."""
    if not value.shape:
        return None
    return tuple(n if isinstance(n, int) and n > 0 else None for n in value.shape)
