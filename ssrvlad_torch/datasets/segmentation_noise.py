"""Errors like those of a segmentation network: functions of ``(H, W)`` uint8 Cityscapes ids, a
strength and a random generator. Smooth random fields choose the pixels."""

import math

import numpy as np
from numpy.typing import NDArray
from PIL import Image

LabelMap = NDArray[np.uint8]

THIN_IDS = (17, 18, 19, 20)  # pole, pole group, traffic light, traffic sign
BLOB_IDS = (7, 8, 11, 12, 13, 21, 22, 23, 26)
CONFUSED_WITH = {7: 8, 8: 7, 9: 8, 11: 12, 12: 13, 13: 11, 14: 13, 22: 8}


def add_errors(labels: LabelMap, strength: float, rng: np.random.Generator) -> LabelMap:
    """A copy of a label map with all errors; of strength 1 a good network's, of 5 a bad one's."""
    noisy = labels.copy()
    for add_error, generator in zip(ERRORS, rng.spawn(len(ERRORS)), strict=True):
        noisy = add_error(noisy, strength, generator)
    return noisy


def lose_poles(labels: LabelMap, strength: float, rng: np.random.Generator) -> LabelMap:
    """Replace thin objects, in a fifth of the image, by the nearest other label on their left."""
    lost = np.isin(labels, THIN_IDS) & _regions(rng, labels.shape, 0.2 * strength, cells=8)
    lost[:, 0] = False
    columns = np.arange(labels.shape[1])
    source = np.maximum.accumulate(np.where(lost, 0, columns), axis=1)
    return np.take_along_axis(labels, source, axis=1)


def confuse(labels: LabelMap, strength: float, rng: np.random.Generator) -> LabelMap:
    """Replace classes by similar ones in a tenth of the image."""
    rename = np.arange(256, dtype=np.uint8)
    rename[list(CONFUSED_WITH)] = list(CONFUSED_WITH.values())
    return np.where(_regions(rng, labels.shape, 0.1 * strength, cells=5), rename[labels], labels)


def add_blobs(labels: LabelMap, strength: float, rng: np.random.Generator) -> LabelMap:
    """Paint blobs of random classes over 1 % of the image."""
    classes = rng.choice(np.array(BLOB_IDS, np.uint8), size=(4, 4))
    enlarged = Image.fromarray(classes).resize(labels.shape[::-1], Image.Resampling.NEAREST)
    painted = np.asarray(enlarged)
    return np.where(_regions(rng, labels.shape, 0.01 * strength, cells=10), painted, labels)


def wobble(labels: LabelMap, strength: float, rng: np.random.Generator) -> LabelMap:
    """Displace the pixels by a smooth field of about 0.4 % of the image diagonal."""
    height, width = labels.shape
    pixels = 0.004 * strength * math.hypot(height, width)
    coarse_y, fine_y, coarse_x, fine_x = (
        _smooth_field(rng, labels.shape, cells) for cells in (10, 24, 10, 24)
    )
    down, right = np.rint(pixels * (coarse_y + fine_y)), np.rint(pixels * (coarse_x + fine_x))
    rows = np.clip(np.arange(height)[:, None] + down, 0, height - 1).astype(np.intp)
    columns = np.clip(np.arange(width) + right, 0, width - 1).astype(np.intp)
    displaced: LabelMap = labels[rows, columns]
    return displaced


ERRORS = (lose_poles, confuse, add_blobs, wobble)


def _regions(
    rng: np.random.Generator, shape: tuple[int, ...], fraction: float, cells: int
) -> NDArray[np.bool_]:
    """Smooth random regions that cover a `fraction` (clipped to 0..1) of the image."""
    if not fraction:
        return np.zeros(shape, bool)
    field = _smooth_field(rng, shape, cells)
    return field <= np.quantile(field, min(fraction, 1.0))


def _smooth_field(
    rng: np.random.Generator, shape: tuple[int, ...], cells: int
) -> NDArray[np.float32]:
    """Normal random numbers on a grid of `cells` x `cells`, interpolated to `shape`."""
    grid = Image.fromarray(rng.standard_normal((cells, cells)).astype(np.float32))
    return np.asarray(grid.resize((shape[1], shape[0]), Image.Resampling.BICUBIC))
