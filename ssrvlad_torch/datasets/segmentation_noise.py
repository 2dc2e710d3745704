"""Mistakes like those of a segmentation network, put into a clean label map.

Real label maps are wrong in a few typical ways: boundaries wobble, thin poles are lost, similar
classes are mixed up over a region, and here and there stands a blob of something else. Each of
these is one small function; all are driven by smooth random fields, so the mistakes have the
extent of regions, not of pixels, and scale with the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

LabelMap = NDArray[np.uint8]

THIN_IDS = (17, 18, 19, 20)  # pole, pole group, traffic light, traffic sign
BLOB_IDS = (7, 8, 11, 12, 13, 21, 22, 23, 26)
CONFUSED_WITH = {7: 8, 8: 7, 9: 8, 11: 12, 12: 13, 13: 11, 14: 13, 22: 8}


@dataclass(frozen=True)
class SegmentationNoise:
    """Which mistakes to make, and how badly.

    Args:
        strength: scales every part; 0 changes nothing, 1 is a mild network, about 5 a bad one.
        wobble: displace boundaries smoothly, by about 0.4 % of the image diagonal at strength 1.
        lost_poles: replace poles, lights and signs by what is left of them in a fifth of the image.
        confusion: rename building, wall, fence, road, sidewalk, ... in a tenth of the image.
        blobs: paint wrong classes over 1 % of the image.
    """

    strength: float = 1.0
    wobble: bool = True
    lost_poles: bool = True
    confusion: bool = True
    blobs: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.strength) and self.strength >= 0):
            raise ValueError(f"noise strength: got {self.strength}, expected a finite number >= 0")

    def apply(self, labels: LabelMap, rng: np.random.Generator) -> LabelMap:
        """Return a noisy copy of a label map.

        Each part draws from its own child of `rng`, so switching one off leaves the others alone.

        Shape:
            labels: (H, W) uint8 Cityscapes ids. Output: the same.
        """
        poles, confusion, blobs, wobble = rng.spawn(4)
        noisy = labels.copy()
        if self.lost_poles:
            noisy = _lose_poles(noisy, 0.2 * self.strength, poles)
        if self.confusion:
            noisy = _confuse(noisy, 0.1 * self.strength, confusion)
        if self.blobs:
            noisy = _add_blobs(noisy, 0.01 * self.strength, blobs)
        if self.wobble:
            noisy = _wobble(noisy, 0.004 * self.strength, wobble)
        return noisy


def _lose_poles(labels: LabelMap, fraction: float, rng: np.random.Generator) -> LabelMap:
    """Fill thin things in a `fraction` of the image with the nearest other label to their left."""
    lost = np.isin(labels, THIN_IDS) & _regions(rng, labels.shape, fraction, cells=8)
    lost[:, 0] = False
    columns = np.arange(labels.shape[1])
    source = np.maximum.accumulate(np.where(lost, 0, columns), axis=1)
    return np.take_along_axis(labels, source, axis=1)


def _confuse(labels: LabelMap, fraction: float, rng: np.random.Generator) -> LabelMap:
    """Rename classes to similar ones in a `fraction` of the image."""
    rename = np.arange(256, dtype=np.uint8)
    rename[list(CONFUSED_WITH)] = list(CONFUSED_WITH.values())
    return np.where(_regions(rng, labels.shape, fraction, cells=5), rename[labels], labels)


def _add_blobs(labels: LabelMap, fraction: float, rng: np.random.Generator) -> LabelMap:
    """Paint blobs of random classes over a `fraction` of the image."""
    classes = rng.choice(np.array(BLOB_IDS, np.uint8), size=(4, 4))
    painted = np.asarray(
        Image.fromarray(classes).resize(labels.shape[::-1], Image.Resampling.NEAREST)
    )
    return np.where(_regions(rng, labels.shape, fraction, cells=10), painted, labels)


def _wobble(labels: LabelMap, amplitude: float, rng: np.random.Generator) -> LabelMap:
    """Displace every pixel smoothly; `amplitude` is a fraction of the image diagonal."""
    height, width = labels.shape
    pixels = amplitude * math.hypot(height, width)
    offsets = [
        np.rint(
            pixels * (_smooth_field(rng, labels.shape, 10) + _smooth_field(rng, labels.shape, 24))
        )
        for _ in range(2)
    ]
    rows = np.clip(np.arange(height)[:, None] + offsets[0], 0, height - 1).astype(np.intp)
    columns = np.clip(np.arange(width) + offsets[1], 0, width - 1).astype(np.intp)
    displaced: LabelMap = labels[rows, columns]
    return displaced


def _regions(
    rng: np.random.Generator, shape: tuple[int, ...], fraction: float, cells: int
) -> NDArray[np.bool_]:
    """Smooth random regions that cover a `fraction` (clipped to 0..1) of the image."""
    field = _smooth_field(rng, shape, cells)
    return (
        field <= np.quantile(field, min(fraction, 1.0)) if fraction > 0 else np.zeros(shape, bool)
    )


def _smooth_field(
    rng: np.random.Generator, shape: tuple[int, ...], cells: int
) -> NDArray[np.float32]:
    """Normal random numbers on a grid of `cells` x `cells`, interpolated to `shape`."""
    grid = Image.fromarray(rng.standard_normal((cells, cells)).astype(np.float32))
    return np.asarray(grid.resize((shape[1], shape[0]), Image.Resampling.BICUBIC))
