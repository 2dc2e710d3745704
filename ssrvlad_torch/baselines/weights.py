"""Published weights on disk: finds the files, reads them as they are published, fills networks.
Nothing is downloaded, and no code of a file is run."""

import pickle
from collections.abc import Mapping, Sequence
from copyreg import _reconstructor  # type: ignore[attr-defined]
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..files import naming, requiring

_CAFFE = """
name: "caffe.proto" package: "caffe"
message_type { name: "Net" field { name: "layer" number: 100 label: LABEL_REPEATED
  type: TYPE_MESSAGE type_name: "Layer" } }
message_type { name: "Layer"
  field { name: "name" number: 1 label: LABEL_OPTIONAL type: TYPE_STRING }
  field { name: "blobs" number: 7 label: LABEL_REPEATED type: TYPE_MESSAGE type_name: "Blob" } }
message_type { name: "Blob"
  field { name: "data" number: 5 label: LABEL_REPEATED type: TYPE_FLOAT options { packed: true } }
  field { name: "shape" number: 7 label: LABEL_OPTIONAL type: TYPE_MESSAGE type_name: "Shape" } }
message_type { name: "Shape"
  field { name: "dim" number: 1 label: LABEL_REPEATED type: TYPE_INT64 options { packed: true } } }
"""
"""What is read of Caffe's ``NetParameter``."""


def weights_folder() -> Path:
    """The default folder of weights: ``~/.cache/ssrvlad/weights``."""
    return Path.home() / ".cache" / "ssrvlad" / "weights"


def find_weights(weights: str | Path | None, names: Sequence[str], origin: str) -> Path:
    """The file of a method's weights, or in a folder, by default `weights_folder`, the first
    published name. A FileNotFoundError says what is missing and who has it."""
    path = weights_folder() if weights is None else Path(weights).expanduser()
    folder = weights is None or path.is_dir()
    for candidate in [path / name for name in names] if folder else [path]:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"no weights at {path}: expected {' or '.join(names)}, published by {origin}; "
        f"put it into {weights_folder()}, or name the file or its folder"
    )


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a PyTorch checkpoint, bare or under ``state_dict``, without the ``module.`` of
    ``nn.DataParallel``; anything else is a ValueError."""
    scalar = np.float64(0).__reduce__()[0]  # under NumPy's old and new modules
    numbers: list[Any] = [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    kinds = (np.float32, np.float64, np.int32, np.int64, bool)
    numbers += [np.dtype, *(type(np.dtype(kind)) for kind in kinds)]
    unpickled = torch.serialization.safe_globals(numbers)
    with naming(f"{path} is not a whole PyTorch checkpoint"), unpickled:
        content = torch.load(path, map_location="cpu", weights_only=True)
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    pairs = state.items() if isinstance(state, dict) else ()
    tensors = {str(k).replace("module.", ""): v for k, v in pairs if isinstance(v, Tensor)}
    if not tensors:
        raise ValueError(f"{path} must hold tensors by name, bare or under state_dict; it has none")
    return tensors


def read_caffe(path: Path) -> dict[str, Tensor]:
    """Weights and biases of a ``.caffemodel``, as ``LAYER.weight`` and ``LAYER.bias``; a damaged
    file is a ValueError. It needs the extra ``onnx``, which brings protobuf."""
    with requiring("onnx", "a .caffemodel needs"):
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
    pool = descriptor_pool.DescriptorPool()
    pool.Add(text_format.Parse(_CAFFE, descriptor_pb2.FileDescriptorProto()))
    make = message_factory.GetMessageClass(pool.FindMessageTypeByName("caffe.Net"))
    with naming(f"{path} is no whole .caffemodel"):
        return {
            f"{layer.name}.{kind}": torch.tensor(blob.data).reshape(*blob.shape.dim)
            for layer in make.FromString(path.read_bytes()).layer
            for kind, blob in zip(("weight", "bias"), layer.blobs, strict=False)
        }


def read_vocabulary(path: Path, keys: Sequence[str], shape: tuple[int, int]) -> Tensor:
    """The centres of a k-means of scikit-learn in a pickle of nested dictionaries with these keys,
    float32; a ValueError for another file. Of a pickle only arrays and empty objects are made."""
    with naming(f"{path} is no vocabulary"):
        with path.open("rb") as file:
            content = _Arrays(file, encoding="latin1").load()
        for key in keys:
            content = {str(name): value for name, value in content.items()}[key]
        words = torch.from_numpy(content.cluster_centers_.astype(np.float32))
        if words.shape != shape or not words.isfinite().all():
            raise ValueError(f"expected {shape} finite numbers, got {tuple(words.shape)}")
    return words


class _Attributes:
    """An object of a class that is not there, with its attributes."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            vars(self).update(state)


class _Arrays(pickle.Unpickler):
    """Reads arrays and objects of scikit-learn, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """See `pickle.Unpickler`."""
        if module.startswith(("sklearn.", "numpy.random")):
            return _Attributes
        names = {
            "_reconstruct": np.zeros(0).__reduce__()[0],
            "scalar": np.float64(0).__reduce__()[0],
            "ndarray": np.ndarray,
            "dtype": np.dtype,
            "_reconstructor": _reconstructor,
            "object": object,
            "encode": lambda text, _: text.encode("latin1"),
        }
        if name not in names:
            raise ValueError(f"it holds {module}.{name}")
        return names[name]


def fill(network: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Loads weights into a network, which may be on ``meta``, and ignores others. A tensor that is
    missing, of another shape or not finite is a ValueError."""
    expected = network.state_dict()
    for name, tensor in expected.items():
        weight = state.get(name)
        if weight is None:
            has = ", ".join(list(state)[:3])
            raise ValueError(f"{path} lacks {name} {tuple(tensor.shape)}; it has {has}, ...")
        if weight.shape != tensor.shape:
            shapes = f"{tuple(tensor.shape)}, got {tuple(weight.shape)}"
            raise ValueError(f"{path}: {name} must be {shapes}")
        if not bool(weight.isfinite().all()):
            raise ValueError(f"{path}: {name} holds values that are not finite")
    weights = {name: state[name].to(tensor.dtype) for name, tensor in expected.items()}
    network.load_state_dict(weights, assign=True)
