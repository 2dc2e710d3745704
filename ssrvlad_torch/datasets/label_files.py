"""Label maps on disk: finding them in folders, globs and stacks, and reading each format."""

import hashlib
import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.format import MAGIC_PREFIX
from PIL import Image

from ..files import parse_npy
from ..taxonomy import LabelSpace
from .frame_files import FileKind, FrameFile, find_frames
from .image_files import checked_image, decoding, raw_mode_of

SUFFIXES = (".png", ".npy", ".tif", ".tiff", ".bmp")
_FORMATS = ("PNG", "TIFF", "BMP")
_SIXTEEN_BIT_LOW_BYTE = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L", "LA;16B": "RGBA"}

LabelMap = npt.NDArray[np.integer[Any]]


def _is_stack(array: npt.NDArray[Any]) -> bool:
    """Whether an array is label maps ``(N, H, W)``, and not one map with channels or one-hot."""
    if array.ndim != 3 or array.dtype.kind not in "iu" or array.shape[1] == 1 or array.shape[2] < 5:
        return False
    # of a large stack only the first rows are read: one-hot already there, or nowhere
    heads = (array[:, :1], 0), (array[:1], 2)
    return not any(_is_one_hot(head, axis) and _is_one_hot(array, axis) for head, axis in heads)


def _is_one_hot(array: npt.NDArray[Any], axis: int) -> bool:
    """Whether most pixels have one value in one channel of an axis, and no pixel has more."""
    counts = np.count_nonzero(array, axis)
    value = array.max()
    return bool(counts.max() == 1 and counts.mean() > 0.5 and np.isin(array, (0, value)).all())


find_label_files = partial(find_frames, FileKind("label maps", SUFFIXES, _is_stack))
"""The label maps of the sources; see `find_frames`. A ``.npy`` stack is ``(N, H, W)``."""


_FORMS_OF_LABELS = {
    "ids": ("labelIds", "color", "labelColor", "labelTrainIds"),
    "trainids": ("labelTrainIds", "color", "labelColor", "labelIds"),
}
"""Ends of the names of Cityscapes and its like, the best first."""
_FORM = re.compile(r"(.+)_(\w*Ids|color|labelColor|invGray)")
_TRUCK = 27
"""An id that only the whole list of Cityscapes has."""


def one_of_each_place(
    space: LabelSpace, files: list[FrameFile], note: Callable[[str], object]
) -> list[FrameFile]:
    """The files with only that form of a label map that fits a label space best, as in gtFine of
    ``X_labelIds.png``, ``X_labelTrainIds.png``, ``X_color.png``. How many are left out is noted."""
    has_ids = any(label.id == _TRUCK for label in space.classes)
    order = _FORMS_OF_LABELS["ids" if has_ids else "trainids"]
    best = dict[tuple[Path, str], tuple[int, FrameFile]]()
    forms = [(file, match) for file in files if (match := _FORM.fullmatch(file.name))]
    for file, match in forms:
        rank = order.index(match[2]) if match[2] in order else len(order)
        place = file.path.parent, match[1]
        best[place] = min(best.get(place, (rank, file)), (rank, file), key=lambda pair: pair[0])
    chosen = {file.path for _, file in best.values()}
    unchosen = {file.path for file, _ in forms} - chosen
    if unchosen:
        note(f"{len(unchosen)} files are other forms of a label map, for example {min(unchosen)}")
    return [file for file in files if file.path not in unchosen]


def read_label_map(file: FrameFile, space: LabelSpace) -> LabelMap:
    """The ids of a label map, ``(H, W)`` uint8, uint16 or signed, in the machine's byte order.

    Reads gray of 8 or 16 bits, palettes (`_ids_of_palette`), several channels of 16 bits (the first
    is the class), colours of the label space, three equal channels, only a red one (CARLA), and
    ``.npy``. Where the ``index_is_id``, colours do not count. Damaged files, several pages, a
    colour that the label space lacks, and a palette that can mean two things are a ValueError."""
    content = file.read()
    is_array = file.path.suffix.lower() == ".npy" or content.startswith(MAGIC_PREFIX)
    with decoding(f"cannot identify the image; expected {', '.join(_FORMATS)}"):
        if is_array:
            labels = parse_npy(content)
        else:
            labels = _decode_image(content, None if file.index_is_id else space)
    if labels.ndim == 3 and labels.shape[2] == 1:
        labels = labels[..., 0]
    if labels.ndim != 2 or labels.size == 0 or labels.dtype.kind not in "iu":
        raise ValueError(
            f"expected an (H, W) integer label map or a stack (N, H, W) of them, got "
            f"{labels.shape} {labels.dtype}"
        )
    if labels.dtype.kind == "u" and labels.dtype.itemsize > 2:
        # torch would truncate unsigned ids of 32 or 64 bits, and an unknown id could become known
        return labels.astype(np.uint64).clip(max=np.iinfo(np.int64).max).astype(np.int64)
    return labels.astype(labels.dtype.newbyteorder("="), copy=False)


def digest(labels: LabelMap) -> str:
    """128 bits of SHA-256 of a label map's ids and shape; it does not depend on the file format."""
    if labels.dtype != np.uint8:
        labels = labels.astype(np.int64 if labels.min() < 0 or labels.max() > 255 else np.uint8)
    content = hashlib.sha256(str(labels.shape).encode())
    content.update(np.ascontiguousarray(labels).data)
    return content.hexdigest()[:32]


def _decode_image(content: bytes, space: LabelSpace | None) -> npt.NDArray[Any]:
    """The ids in an image; without a label space the index of a palette, or the first channel."""
    with checked_image(content, _FORMATS) as image:
        raw_mode = raw_mode_of(image)
        if image.format == "PNG" and raw_mode in _SIXTEEN_BIT_LOW_BYTE:
            return _first_of_sixteen_bit_channels(image, content, raw_mode)
        if image.mode in ("L", "LA", "RGB", "RGBA") and ";" in raw_mode:
            raise ValueError(
                f"pixels stored as {raw_mode} would be read scaled; expected gray of 8 or 16 bits, "
                "or colours of 8, or 16 in a PNG"
            )
        pixels = np.asarray(image)
        first = pixels if pixels.ndim == 2 else pixels[..., 0]
        if image.mode in ("P", "PA"):
            colours = np.array(image.getpalette(), np.uint8).reshape(-1, 3)
            return _ids_of_palette(first, colours, space) if space else first
        if image.mode in ("RGB", "RGBA"):
            return _ids_of_colours(pixels[..., :3], space) if space else first
        if image.mode not in ("L", "LA", "I", "I;16", "I;16B", "I;16L"):
            raise ValueError(f"expected a label image, got an image of mode {image.mode}")
        return first


def _first_of_sixteen_bit_channels(
    image: Image.Image, content: bytes, raw_mode: str
) -> npt.NDArray[Any]:
    """The first channel of an image of 16-bit channels. Pillow reads only the high bytes. Read
    again with swapped bytes, it gives the low bytes; gray with alpha is read as four bytes, and the
    second is the low one."""
    high = np.asarray(image)[..., 0].astype(np.uint16)
    with Image.open(io.BytesIO(content), formats=_FORMATS) as swapped:
        tiles = [tile._replace(args=_SIXTEEN_BIT_LOW_BYTE[raw_mode]) for tile in swapped.tile]
        swapped.tile = tiles
        low = np.asarray(swapped)[..., 1 if raw_mode == "LA;16B" else 0]
    return np.asarray(high << 8 | low)


def _ids_of_palette(
    indices: npt.NDArray[np.uint8], colours: npt.NDArray[np.uint8], space: LabelSpace
) -> npt.NDArray[Any]:
    """Ids of a palette image: its indices, unless the colours that its pixels have are those of
    other ids of the label space: optimisers of PNG choose indices of their own. Grays that are not
    the indices, and colours of which some are those of other ids and some of none, are a
    ValueError. The programs in ``export/`` have the same rule."""
    ids, colour_of = _ids_by_colour(space), {label.id: label.colour for label in space.classes}
    used = np.flatnonzero(np.bincount(indices.ravel())).tolist()
    shown = {i: tuple(colours[i : i + 1].ravel().tolist()) for i in used}
    differing = [i for i in used if shown[i] != (colour_of.get(i) or (0, 0, 0))]
    moved = {i: ids[shown[i]] for i in differing if shown[i] in ids}
    strays = [i for i in differing if i not in moved]
    unclear = strays if moved else []
    if all(len(set(colour)) == 1 for colour in shown.values()):
        is_id = strays and all(shown[i] == (i, i, i) for i in used)
        moved, unclear = {}, [] if is_id else differing
    if unclear:
        raise ValueError(
            f"the palette shows index {unclear[0]} as {shown[unclear[0]]}; expected colours of the "
            "label space alone, or an image without palette, to tell which is the id"
        )
    table = np.arange(256, dtype=np.int32)
    table[list(moved)] = list(moved.values())
    return np.asarray(table[indices]) if moved else indices


def _ids_by_colour(space: LabelSpace) -> dict[tuple[int, ...], int]:
    """The id of each colour: the largest where classes of one category share it."""
    classes = sorted(space.classes, key=lambda label: label.id)
    return {label.colour: label.id for label in classes if label.colour}


def _ids_of_colours(pixels: npt.NDArray[np.uint8], space: LabelSpace) -> npt.NDArray[Any]:
    """Ids of a label image of three channels: of its colours, but its red channel where the others
    equal it or are 0, and its values are ids and not all colours of the label space."""
    red, green_blue, id_of = pixels[..., 0], pixels[..., 1:], _ids_by_colour(space)
    is_gray = bool((green_blue == red[..., None]).all())
    if is_gray or not green_blue.any():
        used = np.flatnonzero(np.bincount(red.ravel())).tolist()
        shown = {(i, i * is_gray, i * is_gray) for i in used}
        if {label.id for label in space.classes}.issuperset(used) and shown - id_of.keys():
            return red
    packed = pixels.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32)
    ids = np.full(packed.shape, np.iinfo(np.int32).min, np.int32)
    for (red_of, green, blue), label_id in id_of.items():
        ids[packed == (red_of << 16 | green << 8 | blue)] = label_id
    unknown = packed[ids == np.iinfo(np.int32).min]
    if len(unknown):
        colour = tuple(int(unknown[0]) >> shift & 255 for shift in (16, 8, 0))
        count = int((unknown == unknown[0]).sum())
        raise ValueError(
            f"colour {colour} ({count} pixels) is not in label space {space.name}; "
            "is this a photo, or labels of another space?"
        )
    return ids
