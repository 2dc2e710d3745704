"""Networks that Caffe saved: the arrays of a ``.caffemodel``, without Caffe and without protobuf.

A ``.caffemodel`` is a ``NetParameter`` message of ``caffe.proto``. Only four of its message types
matter, and of the wire format of protocol buffers only how fields follow each other:

- ``NetParameter``: ``layer`` is field 100, in files of before 2015 ``layers``, field 2
- ``LayerParameter``: ``name`` is 1, ``blobs`` 7; ``V1LayerParameter``: ``name`` is 4, ``blobs`` 6
- ``BlobProto``: ``shape`` is 7, ``data`` 5; before 2015 ``num`` to ``width``, fields 1 to 4
- ``BlobShape``: ``dim`` is 1
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LAYERS = {100: (1, 7), 2: (4, 6)}
"""Fields of a network's layers, and the fields of name and blobs in each."""

Field = tuple[int, int | memoryview]


def read_caffemodel(path: Path) -> dict[str, Tensor]:
    """The weights and biases of a Caffe network's layers.

    Returns:
        ``<layer>.weight`` and ``<layer>.bias`` float32, in Caffe's shapes: a convolution's is
        ``(out, in / groups, h, w)``, as in PyTorch.

    Raises:
        ValueError: the file is not a Caffe network, or is damaged.
        OSError: the file cannot be read.
    """
    tensors: dict[str, Tensor] = {}
    try:
        for field, layer in _fields(memoryview(path.read_bytes())):
            if field in _LAYERS and isinstance(layer, memoryview):
                name, blobs = _layer(layer, *_LAYERS[field])
                pairs = zip(("weight", "bias"), blobs, strict=False)
                tensors |= {f"{name}.{kind}": blob for kind, blob in pairs}
    except (IndexError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} is not a whole Caffe network: {error}") from error
    if not tensors:
        raise ValueError(f"{path} is not a Caffe network: it has no layer with weights")
    return tensors


def _layer(message: memoryview, name_field: int, blob_field: int) -> tuple[str, list[Tensor]]:
    name, blobs = "", []
    for field, value in _fields(message):
        if field == name_field and isinstance(value, memoryview):
            name = bytes(value).decode()
        elif field == blob_field and isinstance(value, memoryview):
            blobs.append(_blob(value))
    return name, blobs


def _blob(message: memoryview) -> Tensor:
    """The array of a ``BlobProto``; both arrays in it are packed or, in old writers, repeated."""
    data, shape, old_shape = bytearray(), [], []
    for field, value in _fields(message):
        if field == 5 and isinstance(value, memoryview):
            data += value
        elif field == 7 and isinstance(value, memoryview):
            shape = [size for _, part in _fields(value) for size in _integers(part)]
        elif field in (1, 2, 3, 4) and isinstance(value, int):
            old_shape.append(value)
    if not shape:
        ones = next((i for i, size in enumerate(old_shape) if size != 1), len(old_shape) - 1)
        shape = old_shape[ones:]
    return torch.from_numpy(np.frombuffer(data, "<f4").astype(np.float32)).reshape(shape)


def _integers(value: int | memoryview) -> Iterator[int]:
    """One integer, or those of a packed field."""
    if isinstance(value, int):
        yield value
        return
    at = 0
    while at < len(value):
        number, at = _varint(value, at)
        yield number


def _fields(message: memoryview) -> Iterator[Field]:
    """Number and content of each field; four and eight bytes are given as bytes."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        field, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
            yield field, value
            continue
        if kind == _BYTES:
            size, at = _varint(message, at)
        elif kind in (_FIXED32, _FIXED64):
            size = 4 if kind == _FIXED32 else 8
        else:
            raise ValueError(f"field {field} has wire type {kind}")
        if at + size > len(message):
            raise ValueError(f"field {field} ends {at + size - len(message)} bytes after the file")
        yield field, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """An integer in groups of seven bits, lowest first, and where it ends."""
    number = shift = 0
    while True:
        byte = message[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return number, at
