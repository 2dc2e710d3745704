"""The method for one image, plainly: NumPy, scikit-image and scipy, one layer after another.

This file defines the answer. It is written for reading next to the paper, and every fast path
is held to it: masks and counts equal, descriptors within 1e-6. It needs the extra ``eval``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from .config import CATEGORY_COUNT, SSRVLADConfig
from .taxonomy import NO_LAYER, LabelSpace, label_space

try:
    from skimage import measure, morphology
except ImportError as error:
    raise ImportError("ssrvlad_torch.reference needs: pip install ssrvlad-torch[eval]") from error

Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

CELLS = (24, 32)
"""Rows and columns of the grid of cells."""


@dataclass(frozen=True)
class LayerTrace:
    """One layer of one image, step by step; points are ``(n, 2)`` rows and columns.

    ``centre`` is ``None`` for a layer without pixels. ``histograms`` are ``(N, M)`` each: for
    residuals ``points``, the sum of all d_i of Eq. 2, and ``centre``, d_c; for harmonics ``bins``,
    what stands in the soft bins.
    """

    layer: Mask
    clean: Mask
    skeleton: Mask
    end_points: Mask
    intersections: Mask
    centre: tuple[int, int] | None
    histograms: dict[str, npt.NDArray[Any]]
    vector: Floats


def describe(label_map: npt.NDArray[Any], config: SSRVLADConfig) -> npt.NDArray[np.float32]:
    """The descriptor of one image.

    Args:
        label_map: ``(H, W)`` integer ids of the label space ``config.labels_as``.
        config: the settings.

    Returns:
        ``(480,)`` float32 of length 1, or zeros for an image in which no layer has a keypoint.

    Raises:
        ValueError: an id outside the label space.
    """
    return concatenate(trace_layers(label_map, config))


def trace_layers(label_map: npt.NDArray[Any], config: SSRVLADConfig) -> list[LayerTrace]:
    """The eight layers of one image, step by step; arguments and errors as for `describe`."""
    categories = categorise(label_map, label_space(config.labels_as))
    categories = reduce_by_majority(categories, config.grid(*categories.shape))
    layers = [categories == k for k in range(CATEGORY_COUNT)]
    clean = [clean_layer(layer, config) for layer in layers]
    if config.aggregation == "residuals":
        return [trace_residuals(*pair, config) for pair in zip(layers, clean, strict=True)]
    shift = vanishing_column(clean) if config.anchor == "vanishing-column" else 0
    return [trace_harmonics(*pair, shift, config) for pair in zip(layers, clean, strict=True)]


def trace_residuals(layer: Mask, clean: Mask, config: SSRVLADConfig) -> LayerTrace:
    """One layer of the paper, from its pixels to its vector V(k)."""
    skeleton = thin(clean, config.thinning)
    ends, crossings = end_points(skeleton), intersections(skeleton)
    points = np.argwhere(ends | crossings)
    context = np.argwhere(skeleton) if config.context == "skeleton" else points
    centre = centroid(clean)

    limits = config.ring_limits(*layer.shape)
    around_centre = np.zeros((config.rings, config.sectors), np.int64)
    around_points = np.zeros_like(around_centre)
    if centre is not None:
        around_centre = shape_context(centre, context, limits, config.sectors)
    for point in points:
        around_points += shape_context(point, context, limits, config.sectors)
    residual = around_points - len(points) * around_centre  # Eq. 2
    vector = normalise(residual.ravel().astype(np.float64))
    histograms = {"points": around_points, "centre": around_centre}
    return LayerTrace(layer, clean, skeleton, ends, crossings, centre, histograms, vector)


def trace_harmonics(layer: Mask, clean: Mask, shift: int, config: SSRVLADConfig) -> LayerTrace:
    """One layer around the vanishing column, from its pixels to its coefficients."""
    skeleton = thin(clean, config.thinning)
    area = np.sqrt(soft_histogram(pool(layer, shift), config))
    lengths = pool(skeleton, shift) * (min(layer.shape) / CELLS[0])
    histogram = area + config.skeleton_weight * np.sqrt(soft_histogram(lengths, config))
    found = np.array([(function * histogram).sum() for function in basis(config)])
    vector = np.sign(found) * np.abs(found) ** config.power
    ends, crossings = end_points(skeleton), intersections(skeleton)
    masks = (layer, clean, skeleton, ends, crossings)
    return LayerTrace(*masks, centroid(clean), {"bins": histogram}, vector)


def concatenate(traces: list[LayerTrace]) -> npt.NDArray[np.float32]:
    """The layers' vectors one after another, normalised."""
    return normalise(np.concatenate([trace.vector for trace in traces])).astype(np.float32)


def categorise(label_map: npt.NDArray[Any], space: LabelSpace) -> Integers:
    """Category 0 to 7 of every pixel (Table II), or `NO_LAYER`."""
    categories = np.full(label_map.shape, -1, np.int64)
    for label in space.classes:
        categories[label_map == label.id] = label.category_index
    if (categories < 0).any():
        unknown = label_map[categories < 0].min()
        raise ValueError(f"label id {unknown} is not in label space {space.name}")
    return categories


def reduce_by_majority(categories: Integers, grid: tuple[int, int]) -> Integers:
    """The commonest category of each cell, the lowest of equally common ones."""
    height, width = categories.shape
    row = np.arange(height) * grid[0] // height
    column = np.arange(width) * grid[1] // width
    reduced = np.empty(grid, np.int64)
    for y in range(grid[0]):
        strip = categories[row == y]
        for x in range(grid[1]):
            reduced[y, x] = np.bincount(strip[:, column == x].ravel(), minlength=NO_LAYER).argmax()
    return reduced


def clean_layer(layer: Mask, config: SSRVLADConfig) -> Mask:
    """Opening, closing, then small enclosed holes filled, then small regions dropped."""
    opening = square(config.radius_pixels(config.opening, *layer.shape))
    closing = square(config.radius_pixels(config.closing, *layer.shape))
    layer = dilate(erode(layer, opening), opening)
    layer = erode(dilate(layer, closing), closing)
    layer = layer | small_holes(layer, config.area_pixels(config.hole_area, *layer.shape))
    return layer & ~small_regions(layer, config.area_pixels(config.region_area, *layer.shape))


def square(radius: int) -> npt.NDArray[np.uint8]:
    """The structuring element of `2 * radius + 1` pixels."""
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def dilate(layer: Mask, element: npt.NDArray[np.uint8]) -> Mask:
    """Dilation; outside the image is ignored."""
    return np.asarray(morphology.dilation(layer, element, mode="ignore"), bool)


def erode(layer: Mask, element: npt.NDArray[np.uint8]) -> Mask:
    """Erosion; outside the image is ignored."""
    return np.asarray(morphology.erosion(layer, element, mode="ignore"), bool)


def small_holes(layer: Mask, area: int) -> Mask:
    """4-connected background regions of fewer than ``area`` pixels that touch no border."""
    holes = np.zeros_like(layer)
    for region in measure.regionprops(measure.label(~layer, connectivity=1)):
        top, left, bottom, right = region.bbox
        enclosed = top > 0 and left > 0 and bottom < layer.shape[0] and right < layer.shape[1]
        if enclosed and region.num_pixels < area:
            holes[tuple(region.coords.T)] = True
    return holes


def small_regions(layer: Mask, area: int) -> Mask:
    """8-connected regions of fewer than ``area`` pixels."""
    regions = np.zeros_like(layer)
    for region in measure.regionprops(measure.label(layer, connectivity=2)):
        if region.num_pixels < area:
            regions[tuple(region.coords.T)] = True
    return regions


def neighbours(mask: Mask) -> list[Mask]:
    """p2 ... p9 of the thinning papers: N, NE, E, SE, S, SW, W, NW; outside is background."""
    height, width = mask.shape
    padded = np.pad(mask, 1)
    offsets = [(0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0)]
    return [padded[y : y + height, x : x + width] for y, x in offsets]


def thin(layer: Mask, variant: str) -> Mask:
    """The skeleton by a named variant.

    ``"zhang-suen"`` follows the paper below; ``"guo-hall"`` is ``skimage.morphology.thin``, whose
    two tables are algorithm A1 of Guo & Hall, CACM 32(3), 1989.
    """
    return zhang_suen(layer) if variant == "zhang-suen" else np.asarray(morphology.thin(layer))


def zhang_suen(layer: Mask) -> Mask:
    """Zhang & Suen, A fast parallel algorithm for thinning digital patterns, CACM 27(3), 1984.

    Equal to ``cv2.ximgproc.thinning(THINNING_ZHANGSUEN)`` on a padded image;
    ``skimage.morphology.skeletonize(method="zhang")`` deletes more patterns than the paper.
    """
    while True:
        before = layer
        for first in (True, False):
            ring = neighbours(layer)
            p2, _, p4, _, p6, _, p8, _ = ring
            on = np.sum(ring, axis=0)  # B(P1)
            steps = crossing_number(ring)  # A(P1)
            if first:
                products = (p2 & p4 & p6) | (p4 & p6 & p8)
            else:
                products = (p2 & p4 & p8) | (p2 & p6 & p8)
            layer = layer & ~((on >= 2) & (on <= 6) & (steps == 1) & ~products)
        if (layer == before).all():
            return layer


def crossing_number(ring: list[Mask]) -> Integers:
    """How often the neighbours change from off to on, once around the pixel (Rutovitz)."""
    steps = [~here & there for here, there in zip(ring, ring[1:] + ring[:1], strict=True)]
    return np.asarray(np.sum(steps, axis=0))


def end_points(skeleton: Mask) -> Mask:
    """Skeleton pixels with at most one 8-neighbour."""
    return np.asarray(skeleton & (np.sum(neighbours(skeleton), axis=0) <= 1))


def intersections(skeleton: Mask) -> Mask:
    """Skeleton pixels with crossing number 3 or more and none such W, NW, N or NE of them."""
    crossing = skeleton & (crossing_number(neighbours(skeleton)) >= 3)
    north, northeast, _, _, _, _, west, northwest = neighbours(crossing)
    return crossing & ~(west | northwest | north | northeast)


def centroid(layer: Mask) -> tuple[int, int] | None:
    """Row and column of the centre of the layer's pixels (Eq. 1), halves rounded up."""
    rows, columns = np.nonzero(layer)
    if len(rows) == 0:
        return None
    return (
        int((2 * rows.sum() + len(rows)) // (2 * len(rows))),
        int((2 * columns.sum() + len(rows)) // (2 * len(rows))),
    )


def shape_context(
    point: tuple[int, int] | Integers, context: Integers, limits: tuple[int, ...], sectors: int
) -> Integers:
    """Counts of the context points around a point, ``(N, M)``; the point itself is not counted.

    Ring ``n`` ends at squared distance ``limits[n]``, included. Sector ``m`` begins at the angle
    ``2 pi m / M``, included, counted from +x (right) towards +y (down). The nudge is far below
    the angle between a boundary and any integer offset that is not on it.
    """
    dy, dx = (context - np.asarray(point)).T
    squared = dy**2 + dx**2
    ring = np.searchsorted(limits, squared)
    turn = np.arctan2(dy, dx) / (2 * np.pi)
    sector = np.floor(turn * sectors + 1e-12).astype(np.int64) % sectors
    counted = (squared > 0) & (ring < len(limits))
    histogram = np.zeros((len(limits), sectors), np.int64)
    np.add.at(histogram, (ring[counted], sector[counted]), 1)
    return histogram


def vanishing_column(clean: list[Mask]) -> int:
    """Columns from the middle to where ground, sidewalk and sky are tallest.

    A column weighs by the eighth power of its openness in 64ths, one that is wholly open 2 ** 20;
    the middle weighs as much as a twentieth of all columns, open. Halves are rounded up.
    """
    height, width = clean[0].shape
    openness = (clean[0] | clean[1] | clean[5]).sum(0)
    weights = [(int(pixels) * 64 // height) ** 8 // 2**28 for pixels in openness]
    moment = sum(weight * (2 * x - (width - 1)) for x, weight in enumerate(weights))
    total = sum(weights) + width * 2**20 // 20
    return int((moment + total) // (2 * total))


def pool(layer: Mask, shift: int) -> Floats:
    """The fraction of each cell that a layer covers, once moved ``shift`` columns left."""
    height, width = layer.shape
    tall, wide = overlaps(height, CELLS[0], 0), overlaps(width, CELLS[1], shift)
    sums = tall.T @ layer.astype(np.int64) @ wide
    return np.asarray(sums / (height * width))


def overlaps(pixels: int, cells: int, shift: int) -> Integers:
    """How much of each pixel lies in each cell, in ``1 / (pixels * cells)`` of a side."""
    found = np.zeros((pixels, cells), np.int64)
    for pixel in range(pixels):
        start, end = (pixel - shift) * cells, (pixel - shift + 1) * cells
        for cell in range(cells):
            found[pixel, cell] = max(0, min(end, (cell + 1) * pixels) - max(start, cell * pixels))
    return found


def soft_histogram(cells: Floats, config: SSRVLADConfig) -> Floats:
    """The mean of the cells in each soft bin, ``(N, M)``; bins without cells are 0."""
    weights = soft_bins(config)
    counts, totals = np.tensordot(cells, weights, 2), weights.sum((0, 1))
    means: Floats = np.divide(counts, totals, out=np.zeros_like(counts), where=totals > 0)
    return means


@lru_cache(maxsize=8)
def soft_bins(config: SSRVLADConfig) -> Floats:
    """How much of each cell counts in each ring and sector, ``(rows, columns, N, M)``.

    Each cell is sampled at 4 x 4 points. A point between two ring centres (in the logarithm of the
    distance) and two sector centres counts in all four, linearly. Within the first ring's centre
    the first ring has it all; what is farther than the radius is not counted.
    """
    rows, columns = CELLS
    found = np.zeros((rows, columns, config.rings, config.sectors))
    for sy, sx in np.ndindex(rows * 4, columns * 4):
        dy, dx = (sy + 0.5) / 4 - rows / 2, (sx + 0.5) / 4 - columns / 2
        distance = math.hypot(dy, dx) / math.hypot(rows, columns) / config.radius
        ring = 0.0
        if config.rings > 1 and config.inner_radius < 1:
            steps = math.log(distance) / math.log(1 / config.inner_radius)
            ring = max(0.0, (config.rings - 1) * (1 + steps))
        sector = math.atan2(dy, dx) / (2 * math.pi) * config.sectors
        for n, in_ring in between(ring):
            for m, in_sector in between(sector):
                if distance <= 1 and n < config.rings:
                    found[sy // 4, sx // 4, n, m % config.sectors] += in_ring * in_sector
    return found


def between(position: float) -> list[tuple[int, float]]:
    """The two integers around a position, each with its weight."""
    below = math.floor(position)
    return [(below, 1 - (position - below)), (below + 1, position - below)]


@lru_cache(maxsize=8)
def basis(config: SSRVLADConfig) -> list[Floats]:
    """The smoothest functions over the bins, ``(N, M)`` each, finer ones with more weight."""
    waves = []
    for u in range(config.rings):
        for v in range((config.sectors + 1) // 2):
            waves += [(u * u + v * v, u, v, sine) for sine in ((False, True) if v else (False,))]
    found = []
    for squared, u, v, sine in sorted(waves)[: config.harmonics]:
        rings = np.cos(np.pi * u * (np.arange(config.rings) + 0.5) / config.rings)
        turns = 2 * np.pi * v * np.arange(config.sectors) / config.sectors
        function = np.outer(rings, np.sin(turns) if sine else np.cos(turns))
        found.append(normalise(function) * (1 + squared) ** (config.spectral_weight / 2))
    return found


def normalise(vector: Floats) -> Floats:
    """The vector divided by its L2 norm; zeros stay zeros."""
    norm = np.linalg.norm(vector)
    return vector / norm if norm > 0 else vector
