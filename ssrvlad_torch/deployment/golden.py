"""The golden pair: an input and the module's outputs for it, which every exported file carries."""

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ..descriptor import SSRVLAD
from ..stages.vanishing_column import OPEN_LAYERS
from ..taxonomy import CATEGORIES, VOID, LabelClass

Array = npt.NDArray[Any]

SIZE = (133, 171)
"""Rows and columns: above the working size of every preset, and not multiples of it."""

_IMAGES = 2
"""At least; more if they have too few patches for all ids of a label space."""

PATCHES = 40
_SPECKS = 60
_OPEN = [CATEGORIES[k] for k in OPEN_LAYERS]


def golden_pair(
    head: SSRVLAD, input: str, dtype: str, shape: tuple[int, int, int] | None = None
) -> dict[str, Array]:
    """Label maps of patches and specks of all ids, some outside the label space, or class scores,
    for a file of this ``input`` and dtype, or of a fixed ``shape``; and the outputs of the module,
    all by name. A dtype that can hold no id of the label space is a ValueError."""
    space = head.label_space
    if input == "logits":
        ids = np.arange(space.channel_counts[-1])
    else:
        ids = np.array([label.id for label in space.classes])
        ids = ids[(ids >= 0) & (ids < 256)] if dtype == "uint8" else ids
    if ids.size == 0:
        raise ValueError(f"label space {space.name} has no id from 0 to 255; expected dtype int64")
    images, height, width = shape or (max(_IMAGES, -(-len(ids) // PATCHES)), *SIZE)
    labels = np.stack([_drawn(head, ids, (height, width), number) for number in range(images)])
    if input == "labels":
        unknown = np.setdiff1d(np.arange(256), ids)[-1:]
        if dtype == "int64":
            unknown = ids[:1] + (1 << 40)  # its low 32 bits are an id inside
        if unknown.size:
            rows, columns = np.random.default_rng(1).integers(0, min(height, width), (2, _SPECKS))
            labels[-1, rows, columns] = unknown
    array = as_input(labels, len(ids), input, dtype)
    return {input: array, **outputs_of(head, array)}


def outputs_of(head: SSRVLAD, array: Array) -> dict[str, Array]:
    """The module's outputs for labels or class scores, by the names of a file's outputs. As in a
    file, pixels with an id outside the label space are counted and belong to no layer."""
    space = head.label_space
    ids = [label.id for label in space.classes]
    unknown = np.zeros(array.shape, np.bool_)
    if array.dtype.kind in "iu":
        unknown = ~np.isin(array, ids)
    if unknown.any():
        free = next(number for number in count() if number not in ids)
        array = np.where(unknown, np.array(free, array.dtype), array)
        space = replace(space, classes=(*space.classes, LabelClass(free, "unknown", VOID)))
        head = SSRVLAD(replace(head.config, labels_as=space), head.columns)
    labels = torch.tensor(array)
    outputs = {
        "descriptor": head(labels).numpy(),
        "unknown": unknown.reshape(len(array), -1).sum(1).astype(np.int64),
    }
    if head.config.aggregation == "residuals":
        outputs["keypoints"] = head.explain(labels).keypoints.sum((2, 3)).numpy()
    return outputs


def as_input(labels: Array, channels: int, input: str, dtype: str) -> Array:
    """``(B, H, W)`` ids in a dtype, or ``(B, C, H, W)`` float32 scores: 1 for a pixel's class, else
    0."""
    if input == "labels":
        return labels.astype(dtype)
    return np.equal(labels[:, None], np.arange(channels)[:, None, None]).astype(np.float32)


def patches(rng: np.random.Generator, height: int, width: int) -> npt.NDArray[np.int64]:
    """``(height, width)``, the number of the nearest of `PATCHES` random points."""
    y, x = rng.uniform(0, height, PATCHES), rng.uniform(0, width, PATCHES)
    rows, columns = np.mgrid[:height, :width]
    nearest = np.zeros((height, width), np.int64)
    smallest = np.full((height, width), np.inf)
    for point in range(PATCHES):
        distance = np.hypot(rows - y[point], columns - x[point])
        nearest[distance < smallest] = point
        smallest = np.minimum(smallest, distance)
    return nearest


def photograph(rng: np.random.Generator, height: int, width: int) -> npt.NDArray[np.uint8]:
    """``(height, width, 3)``, patches of a few colours, so that the picture compresses well."""
    drawn = patches(rng, height, width)
    colours = rng.integers(0, 9, (PATCHES, 3)) * 255 // 8
    return colours[drawn].astype(np.uint8)


def _drawn(head: SSRVLAD, ids: Array, size: tuple[int, int], seed: int) -> npt.NDArray[np.int64]:
    """``(H, W)``: each pixel has the id of the nearest of some random points, or is a speck. Every
    second map has a strip of open layers from top to bottom, which moves the vanishing column."""
    height, width = size
    rng = np.random.default_rng(seed)
    ids = np.random.default_rng(0).permutation(ids)
    nearest = patches(rng, height, width)
    labels: npt.NDArray[np.int64] = ids[(nearest + seed * PATCHES) % len(ids)].astype(np.int64)
    open_classes = [label.id for label in head.label_space.classes if label.category in _OPEN]
    open_ids = ids[np.isin(ids, open_classes)]
    if seed % 2 and open_ids.size:
        left = int(rng.integers(0, width))
        labels[:, left : left + 1 + width // 6] = open_ids[0]
    specks = rng.integers(0, labels.size, min(_SPECKS, labels.size // 8))
    labels.flat[specks] = ids[(np.arange(len(specks)) + seed * _SPECKS) % len(ids)]
    return labels
