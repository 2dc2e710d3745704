"""Images on disk: finding them, and decoding them to 8-bit RGB."""

import errno
import io
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.format import MAGIC_PREFIX
from PIL import Image, ImageOps, UnidentifiedImageError
from PIL.ImageFile import ImageFile
from PIL.TiffImagePlugin import TiffImageFile

from ..files import check_pixels, empty_folder, naming, one_line, parse_npy
from .frame_files import FileKind, FrameFile, find_frames
from .names import IMAGE_SUFFIXES
from .poses import write_name

_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF", "PPM")
_SIXTEEN_BIT = ("I;16", "I;16B", "I;16L")
_BITS_PER_SAMPLE, _MAX_SAMPLE_VALUE = 258, 281
"""Tags of TIFF."""
_HIGHEST_ID, _UNIFORM = 40, 0.8
_EIGHT_BIT = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")

Pixels = npt.NDArray[np.uint8]

Picture = str | os.PathLike[str] | Pixels | Image.Image
"""An image file, ``(H, W, 3)`` uint8 in RGB, or an image of Pillow."""


def _is_stack(array: npt.NDArray[Any]) -> bool:
    return array.ndim == 4 and array.shape[3] == 3 and array.dtype == np.uint8


find_image_files = partial(find_frames, FileKind("images", IMAGE_SUFFIXES, _is_stack))
"""The images of sources, also videos and ROS bags; see `find_frames`. A ``.npy`` stack is
``(N, H, W, 3)``."""


def decode_image(content: bytes) -> Pixels:
    """The image ``(H, W, 3)`` uint8 in the bytes of a JPEG, PNG, WebP, BMP, TIFF, PPM or ``.npy``
    file, upright. Gray becomes three channels, alpha is dropped, of 16 bits, or as many as the file
    says, the high 8 are kept. Damaged files, several pages, at most 12 bits in pixels of 16, pixels
    of 32 bits or floats, and label maps are a ValueError."""
    with decoding(f"is no image file; expected {', '.join(_FORMATS)} or .npy"):
        if not content.startswith(MAGIC_PREFIX):
            image = checked_image(content, _FORMATS)
            return _rgb(image, _stated_bits(image, content))
        array = parse_npy(content)
        if array.ndim != 3 or array.shape[2] != 3 or array.size == 0 or array.dtype != np.uint8:
            raise ValueError(
                f"expected an (H, W, 3) uint8 image or a stack (N, H, W, 3) of them, got "
                f"{array.shape} {array.dtype}"
            )
        check_pixels(*array.shape[:2])
        return array


@contextmanager
def decoding(unknown: str) -> Iterator[None]:
    """Turns what a decoder raises into a ValueError of one line, ``unknown`` for no image."""
    try:
        yield
    except Exception as error:  # decoders raise any exception on damaged bytes
        is_unknown = isinstance(error, UnidentifiedImageError)
        raise ValueError(unknown if is_unknown else one_line(error)) from error


def checked_image(content: bytes, formats: tuple[str, ...]) -> ImageFile:
    """The image in a file, verified, not decoded; several pages are a ValueError."""
    with Image.open(io.BytesIO(content), formats=formats) as image:
        check_pixels(image.height, image.width)
        pages = getattr(image, "n_frames", 1)
        if pages > 1 and image.format != "MPO":
            raise ValueError(f"has {pages} pages; expected one, a file for each frame")
        image.verify()  # decoding a PNG does not check its checksums
    return Image.open(io.BytesIO(content), formats=formats)


def read_image(file: FrameFile) -> Pixels:
    """Pixels ``(H, W, 3)`` uint8 of an image on disk; errors as for `decode_image`."""
    return decode_image(file.read())


def pixels_of(picture: Picture) -> Pixels:
    """A picture in memory, from an array, an image of Pillow, or a file. A file that does not exist
    is a FileNotFoundError, what is no picture a ValueError."""
    if isinstance(picture, str | os.PathLike):
        path = Path(picture)
        if not path.exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        with naming(path):
            return read_image(FrameFile("", "", path))
    if isinstance(picture, Image.Image):
        return _rgb(picture)
    if not isinstance(picture, np.ndarray):
        raise ValueError(
            "expected a picture as an (H, W, 3) uint8 array, an image of Pillow or the path of a "
            f"file, got {type(picture).__name__}"
        )
    return picture


def write_pictures(folder: Path, files: Sequence[FrameFile]) -> None:
    """Writes images that have poses under names with their positions, see `write_name`: hard links
    or copies, and PNGs of rows. A folder that is not empty is a ValueError."""
    empty_folder(folder)
    for file in files:
        name = write_name(file.frame.replace("/", "_"), file.pose, file.stamp)
        if file.row is not None:
            Image.fromarray(read_image(file)).save(folder / f"{name}.png")
            continue
        target = folder / f"{name}{file.path.suffix}"
        try:
            target.hardlink_to(file.path)
        except OSError:  # another disk, or an object store
            target.write_bytes(file.read())


def raw_mode_of(image: Image.Image) -> str:
    """Pillow's name for the storage of a pixel, the first argument of the decoder."""
    tiles: Any = getattr(image, "tile", ())
    arguments = tiles[0].args if tiles else ""
    return str(arguments[0] if isinstance(arguments, tuple) and arguments else arguments)


def _stated_bits(image: Image.Image, content: bytes) -> int:
    """How many bits the file says that gray in pixels of 16 bits has."""
    if isinstance(image, TiffImageFile):
        highest, bits = (
            int(np.ravel(image.tag_v2.get(tag, 16))[0])
            for tag in (_MAX_SAMPLE_VALUE, _BITS_PER_SAMPLE)
        )
        is_depth = highest > 255 and highest & (highest + 1) == 0
        return highest.bit_length() if is_depth else bits
    position = 8
    while image.format == "PNG" and position + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, position)
        if kind == b"sBIT":
            return content[position + 8]
        if kind == b"IDAT":
            break
        position += length + 12
    return 16


def _rgb(picture: Image.Image, bits: int = 16) -> Pixels:
    """An image in RGB, as `decode_image` says; ``bits`` are those of gray in pixels of 16."""
    is_wide = ";16" in raw_mode_of(picture)
    image = ImageOps.exif_transpose(picture)
    if image.mode in ("L", "P"):
        require_photograph(np.asarray(image))
    if image.mode in _SIXTEEN_BIT or (image.mode == "I" and picture.format == "PPM"):
        image = Image.fromarray(high_bytes(np.asarray(image).astype(np.uint16), bits))
    elif image.mode not in _EIGHT_BIT:
        raise ValueError(
            f"expected an image of 8 or 16 bits in gray or colour, got mode {image.mode}"
        )
    if "transparency" in image.info:
        image = image.convert("RGBA")
    pixels = np.asarray(image.convert("RGB"))
    if is_wide and image.mode in ("RGB", "RGBA", "LA"):
        _require_bright(int(pixels.max()) << 8 | 255)  # the low bytes are not read
    return pixels


def high_bytes(gray: npt.NDArray[np.uint16], bits: int = 16) -> Pixels:
    """The high 8 of the bits of gray. One of at most 12 bits that is said to have 16, as cameras of
    machines store it, would become black; it is a ValueError."""
    highest = int(gray.max())
    if not 8 <= bits < 16 or highest >> bits:
        _require_bright(highest)
        bits = 16
    return (gray >> (bits - 8)).astype(np.uint8)


def _require_bright(highest: int) -> None:
    bits = highest.bit_length()
    if 0 < bits <= 12:
        raise ValueError(f"of {bits} bits in pixels of 16; expected values up to 65535")


def require_photograph(values: npt.NDArray[np.uint8]) -> None:
    """Raises a ValueError for a label map: small values, or 255, in areas without noise."""
    if values.shape[1] < 2:
        return
    ids = np.flatnonzero(np.bincount(values.ravel(), minlength=256)[:255])
    is_uniform = np.mean(values[:, 1:] == values[:, :-1]) > _UNIFORM
    if len(ids) > 1 and ids[-1] <= _HIGHEST_ID and is_uniform:
        raise ValueError(
            f"expected a photograph, got a label map: {len(ids)} values, {ids[0]} to {ids[-1]}"
        )
