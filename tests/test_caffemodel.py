"""Caffe's networks: the wire format of protocol buffers, written here from its definition."""

from collections.abc import Iterable

import numpy as np
import pytest
import torch
from helpers import refused

from ssrvlad_torch.baselines.caffemodel import read_caffemodel

Blob = np.ndarray


def varint(number: int) -> bytes:
    low = bytes([number & 0x7F | (0x80 if number > 0x7F else 0)])
    return low + (varint(number >> 7) if number > 0x7F else b"")


def integer(field: int, number: int) -> bytes:
    return varint(field << 3) + varint(number)


def message(field: int, content: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(content)) + content


def blob(array: Blob, old: bool = False, packed: bool = True) -> bytes:
    """``BlobProto``: data (5), and shape (7) or, in old files, num to width (1 to 4)."""
    if old:
        padded = (1,) * (4 - array.ndim) + array.shape
        shape = b"".join(integer(1 + i, size) for i, size in enumerate(padded))
    else:
        shape = message(7, message(1, b"".join(varint(size) for size in array.shape)))
    numbers = array.astype("<f4").ravel()
    if packed:
        return shape + message(5, numbers.tobytes())
    return shape + b"".join(varint(5 << 3 | 5) + number.tobytes() for number in numbers)


def network(layers: dict[str, Iterable[Blob]], old: bool = False, packed: bool = True) -> bytes:
    """``NetParameter``, with fields that are of no use between those that are."""
    content = message(1, b"CaffeNet-Places365") + varint(50 << 3 | 1) + bytes(8)
    for name, blobs in layers.items():
        name_field, type_field, blob_field = (4, 5, 6) if old else (1, 2, 7)
        kind = integer(type_field, 4) if old else message(type_field, b"Convolution")
        parts = b"".join(message(blob_field, blob(array, old, packed)) for array in blobs)
        rates = varint(70 << 3 | 5) + bytes(4)
        layer = message(name_field, name.encode()) + kind + rates + parts
        content += message(2 if old else 100, layer)
    return content


LAYERS = {
    "data": [],
    "conv1": [np.random.default_rng(0).random((6, 2, 3, 3)), np.arange(6.0)],
    "relu1": [],
    "fc6": [np.random.default_rng(1).random((4, 200)), np.arange(4.0)],
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "net.caffemodel"


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_layers_come_out_by_name(old, packed, path):
    path.write_bytes(network(LAYERS, old, packed))
    read = read_caffemodel(path)
    assert [*read] == ["conv1.weight", "conv1.bias", "fc6.weight", "fc6.bias"]
    for name in ("conv1", "fc6"):
        for kind, expected in zip(("weight", "bias"), LAYERS[name], strict=True):
            got = read[f"{name}.{kind}"]
            assert got.dtype == torch.float32
            assert got.shape == expected.shape
            np.testing.assert_array_equal(got.numpy(), expected.astype(np.float32))


def test_a_kernel_with_one_output_keeps_its_four_axes(path):
    path.write_bytes(network({"conv": [np.ones((1, 1, 3, 3)), np.ones(1)]}))
    read = read_caffemodel(path)
    assert read["conv.weight"].shape == (1, 1, 3, 3)
    assert read["conv.bias"].shape == (1,)


SHORT = message(7, message(1, varint(5))) + message(5, bytes(16))
OTHERS = [b"", b"\x0b", b"name: 'net'\nlayer { name: 'conv1' }", bytes(100), network({})]


@pytest.mark.parametrize(
    ("content", "error"),
    [
        *((network(LAYERS)[:keep], r"net\.caffemodel is not a") for keep in (30, 100, -1)),
        *((other, r"net\.caffemodel is not a (whole )?Caffe network") for other in OTHERS),
        (
            message(100, message(1, b"conv") + message(7, SHORT)),
            r"shape '\[5\]' is invalid for input of size 4",
        ),
    ],
)
def test_a_cut_file_and_another_file_are_named(content, error, path):
    path.write_bytes(content)
    with refused(error):
        read_caffemodel(path)
