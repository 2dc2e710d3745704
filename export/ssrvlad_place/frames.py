"""Frames on disk: finding them, and reading label maps, class scores and pictures."""

from __future__ import annotations

import io
import math
import os
import re
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

SUFFIXES_OF_MAPS = (".png", ".npy", ".tif", ".tiff", ".bmp")
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".ppm", ".npy")
"""Of photographs, and of all frames."""

_MAP_FORMATS = ("PNG", "TIFF", "BMP")
_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF", "PPM")
_SIXTEEN_BIT = ("I;16", "I;16B", "I;16L")
_EIGHT_BIT = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
_MAX_ID, _MIN_EVEN = 40, 0.8
_NPY = b"\x93NUMPY"


def find_frames(
    sources: Sequence[Path], suffixes: Sequence[str] = SUFFIXES
) -> Iterator[tuple[str, Path]]:
    """Ids ``<folder>/<name>`` and files of frames, those of a folder in natural order.

    The suffixes are those of the files of a folder that are frames.

    Raises:
        ValueError: a source does not exist or holds no frame, or two folders have one name.
    """
    folders, found = dict[str, Path](), dict[str, list[Path]]()
    for source in sources:
        files = [path for path in source.glob("[!.]*") if path.suffix.lower() in suffixes]
        if source.is_file():
            files = [source]
        elif not source.exists():
            raise ValueError(f"{source} does not exist; expected a file or a folder of frames")
        if not files:
            raise ValueError(f"{source} holds no frames; expected {', '.join(suffixes)} files")
        for path in files:
            folder = Path(os.path.normpath(path.absolute())).parent
            if folders.setdefault(folder.name, folder.resolve()) != folder.resolve():
                raise ValueError(f"{folders[folder.name]} and {folder} have one name")
            found.setdefault(folder.name, []).append(path)
    for name, paths in found.items():
        for path in sorted(paths, key=lambda path: _natural(path.stem)):
            yield f"{name}/{path.stem}", path


def read_labels(path: Path, classes: list[dict[str, Any]], dtype: Any) -> Array:
    """The label map in a file, in an array also ``(H, W, 1)``, as ``(H, W)`` of a dtype, by the
    classes of a label space.

    Raises:
        ValueError: it holds something else, or ids that the dtype cannot hold.
    """
    labels = read_npy(path) if _is_npy(path) else _label_picture(path, classes)
    if labels.ndim == 3 and labels.shape[2] == 1:
        labels = labels[..., 0]
    if labels.ndim != 2 or labels.size == 0 or labels.dtype.kind not in "iu":
        raise ValueError(f"expected an (H, W) label map, got {labels.shape} {labels.dtype}")
    converted = labels.astype(dtype)
    changed = int((converted != labels).sum())
    if changed:
        raise ValueError(f"{changed} of {labels.size} pixels have an id outside {dtype}")
    return converted


def read_scores(path: Path, dtype: Any) -> Array:
    """The class scores in a ``.npy`` file, ``(C, H, W)`` of a dtype; else a ValueError."""
    if not _is_npy(path):
        raise ValueError("expected scores (C, H, W) in a .npy file, got another kind of file")
    scores = read_npy(path)
    if scores.ndim != 3 or scores.dtype.kind != "f" or not np.isfinite(scores).all():
        raise ValueError(f"expected finite scores (C, H, W), got {scores.shape} {scores.dtype}")
    return scores.astype(dtype)


def read_photograph(path: Path) -> Array:
    """The picture in a file, ``(H, W, 3)`` uint8 in RGB, as `ssrvlad encode` reads it; another
    file, several pages, gray of at most 12 bits in pixels of 16, pixels of 32 bits or floats, and
    what looks like a label map are a ValueError."""
    pixels = read_npy(path) if _is_npy(path) else _picture(path)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0 or pixels.dtype != np.uint8:
        raise ValueError(f"expected (H, W, 3) uint8, got {pixels.shape} {pixels.dtype}")
    return pixels


def read_npy(path: Path, mmap_mode: Literal["r"] | None = None) -> Array:
    """The array in a `.npy` file.

    Raises:
        ValueError: the file holds something else.
    """
    with path.open("rb") as file:
        if file.read(len(_NPY)) != _NPY:
            raise ValueError("expected an array in a .npy file, got another kind of file")
    return np.asanyarray(np.load(path, mmap_mode, allow_pickle=False))


def _is_npy(path: Path) -> bool:
    return path.suffix.lower() == ".npy"


def _label_picture(path: Path, classes: list[dict[str, Any]]) -> Array:
    """``(H, W)`` ids; of a palette image see `_ids_of_palette`."""
    with _open_image(path, _MAP_FORMATS) as image:
        stored = str(image.tile[0][3]) if image.tile else ""
        scaled = image.mode == "L" and ";" in stored
        if scaled or image.mode not in ("L", "P", "I", *_SIXTEEN_BIT):
            raise ValueError(
                f"expected gray (8 or 16 bits) or a palette, got {image.mode} {stored}"
            )
        pixels = np.asarray(image)
        return _ids_of_palette(pixels, image.getpalette(), classes) if image.mode == "P" else pixels


def _ids_of_palette(indices: Array, colours: list[int], classes: list[dict[str, Any]]) -> Array:
    """The rule of `ssrvlad encode`: ids are the indices, unless the palette shows other ids."""
    known = sorted((each for each in classes if each.get("colour")), key=lambda each: each["id"])
    ids = {tuple(each["colour"]): each["id"] for each in known}
    own = {each["id"]: tuple(each["colour"]) for each in known}
    shown = {int(i): tuple(colours[3 * i : 3 * i + 3]) for i in np.unique(indices).tolist()}
    others = [i for i, colour in shown.items() if colour != own.get(i, (0, 0, 0))]
    moved = {i: ids[shown[i]] for i in others if shown[i] in ids}
    strays = [i for i in others if i not in moved]
    unclear = strays if moved else []
    if all(len(set(colour)) == 1 for colour in shown.values()):
        is_id = strays and all(colour == (i, i, i) for i, colour in shown.items())
        moved, unclear = {}, [] if is_id else others
    if unclear:
        raise ValueError(
            f"the palette shows index {unclear[0]} as {shown[unclear[0]]}; expected colours of the "
            "label space alone, or an image without palette, to tell which is the id"
        )
    table = np.arange(256)
    table[list(moved)] = list(moved.values())
    return table[indices]


def _picture(path: Path) -> Array:
    """``(H, W, 3)`` uint8 RGB, turned upright by its EXIF orientation."""
    with _open_image(path, _FORMATS) as stored:
        from PIL import Image, ImageOps

        image = ImageOps.exif_transpose(stored)
    if image.mode in ("L", "P"):
        _require_photograph(np.asarray(image))
    if image.mode in _SIXTEEN_BIT:
        image = Image.fromarray(_high_bytes(np.asarray(image)))
    elif image.mode not in _EIGHT_BIT:
        raise ValueError(
            f"expected an image of 8 or 16 bits in gray or colour, got mode {image.mode}"
        )
    if "transparency" in image.info:
        image = image.convert("RGBA")
    return np.asarray(image.convert("RGB"))


def _high_bytes(gray: Array) -> Array:
    """Gray of 16 bits as 8; one of at most 12 bits would become black."""
    bits = int(gray.max()).bit_length()
    if 0 < bits <= 12:
        raise ValueError(f"gray of {bits} bits in pixels of 16; expected values up to 65535")
    return (gray >> 8).astype(np.uint8)


def _require_photograph(values: Array) -> None:
    """Refuses a label map: small ids, or 255, in even areas. A dark photograph has noise."""
    if values.shape[1] < 2:
        return
    ids = np.setdiff1d(values, [255])
    is_even = np.mean(values[:, 1:] == values[:, :-1]) > _MIN_EVEN
    if len(ids) > 1 and ids[-1] <= _MAX_ID and is_even:
        raise ValueError(
            f"expected a photograph, got a label map: {len(ids)} values, {ids[0]} to {ids[-1]}"
        )


def _open_image(path: Path, formats: Sequence[str]) -> Any:
    """An image in memory: Pillow turns TIFF files by their orientation tag, but not those that it
    maps into memory."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise ImportError("pictures need: pip install pillow; or give .npy arrays") from error
    content = path.read_bytes()
    try:
        with Image.open(io.BytesIO(content), formats=formats) as image:
            pages = getattr(image, "n_frames", 1)
            if pages > 1 and image.format != "MPO":
                raise ValueError(f"has {pages} pages; expected one, a file for each frame")
            image.verify()  # decoding a PNG does not check its checksums
        return Image.open(io.BytesIO(content), formats=formats)
    except UnidentifiedImageError as error:
        raise ValueError(f"cannot identify the image; expected {', '.join(formats)}") from error


def _natural(name: str) -> tuple[list[tuple[float, str]], str]:
    """Sort key of the order of `ssrvlad encode`: numbers by value, also decimal numbers that are a
    whole name, and before text."""
    decimal = re.fullmatch(r"(\d+)\.(\d+)", name)
    text = f"{decimal[1]}.{decimal[2]:0<20}" if decimal else unicodedata.normalize("NFD", name)
    parts = re.findall(r"\d+|\D", text)
    numbers = [int(p) if p.isdecimal() else unicodedata.digit(p, math.inf) for p in parts]
    known = [(n, "" if n < math.inf else p) for n, p in zip(numbers, parts, strict=True)]
    return known, name
