"""Hostile and damaged files: each function writes one and returns its path."""

import io
import os
import struct
import zipfile
import zlib
from pathlib import Path

from helpers import png_bytes, tiff_bytes
from layout_copies import write as text
from numpy.lib import format as npy

__all__ = ["text"]

ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
"""A YAML document of 0.4 kB that stands for 9 ** 9 texts."""

NESTED = "[" * 100_000
"""Deeper than any parser accepts."""


def made(path: Path) -> Path:
    """A path in a folder that is there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def pipe(path: Path) -> Path:
    """A FIFO that nobody writes to: opening it blocks forever."""
    os.mkfifo(made(path))
    return path


def endless(path: Path) -> Path:
    """A link to a device that never ends."""
    made(path).symlink_to("/dev/zero")
    return path


def png(path: Path, side: int = 13_000, colours: int = 0) -> Path:
    """A PNG of ``side ** 2`` black pixels: 170 million in 165 kB. Gray, or of 3 channels."""
    data = zeros(side * (1 + side * (3 if colours else 1)))
    made(path).write_bytes(png_bytes(side, side, 8, colours, data))
    return path


def tiff(path: Path, side: int = 13_000) -> Path:
    """A deflated TIFF of ``side ** 2`` black pixels."""
    data = zeros(side * side)
    made(path).write_bytes(tiff_bytes(side, side, data, packed=8))
    return path


def array(path: Path, shape: tuple[int, ...], content: bytes = b"", dtype: str = "|u1") -> Path:
    """A ``.npy`` whose header has a shape that its content need not fit."""
    file = io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    npy.write_array_header_1_0(file, header)
    made(path).write_bytes(file.getvalue() + content)
    return path


def archive(path: Path, size: int = 6_000_000_000) -> Path:
    """A ``.npz`` of 6 GB of zeros in 6 MB."""
    head = io.BytesIO()
    npy.write_array_header_1_0(head, {"descr": "|u1", "fortran_order": False, "shape": (1, size)})
    zeros = b"\0" * (1 << 24)
    with (
        zipfile.ZipFile(made(path), "w", zipfile.ZIP_DEFLATED) as target,
        target.open("x.npy", "w", force_zip64=True) as file,
    ):
        file.write(head.getvalue())
        for _ in range(size // len(zeros)):
            file.write(zeros)
        file.write(zeros[: size % len(zeros)])
    return path


def zeros(size: int) -> bytes:
    """``size`` zeros in zlib's format: one packed block, repeated."""
    block, packer = b"\0" * (1 << 20), zlib.compressobj(9, wbits=-15)
    packed = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    count, remainder = divmod(size, len(block))
    checksum = 1
    for _ in range(count):
        checksum = zlib.adler32(block, checksum)
    checksum = zlib.adler32(block[:remainder], checksum)
    packer = zlib.compressobj(9, wbits=-15)
    end = packer.compress(block[:remainder]) + packer.flush()
    return b"\x78\xda" + count * packed + end + struct.pack(">I", checksum)
