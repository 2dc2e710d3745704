"""The method for one image in plain NumPy and scikit-image, one layer after another. It defines the
result: every fast path must give the same masks and counts, and descriptors within 1e-6. It needs
the extra ``eval``."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .config import AREA_LAYERS, CATEGORY_COUNT, FAINT, SSRVLADConfig
from .files import requiring
from .taxonomy import NO_LAYER, label_space

with requiring("eval", "ssrvlad_torch.reference needs"):
    from skimage import measure, morphology, segmentation

Mask = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

CELLS = (24, 32)  # rows and columns
SIDE, SIGNS = 16, 128  # rows and columns of cells of features, and signs of each


class LayerTrace(NamedTuple):
    """One layer of one image, step by step; ``centre`` is ``None`` for a layer without pixels."""

    layer: Mask
    clean: Mask
    skeleton: Mask
    end_points: Mask
    intersections: Mask
    centre: tuple[int, int] | None


class Description(NamedTuple):
    """The descriptor of one image and its histograms, ``(blocks, N, M)`` each: for residuals
    ``points``, the sum of all d_i of Eq. 2, and ``centre``, d_c; for harmonics ``bins``, of the
    soft bins."""

    histograms: dict[str, npt.NDArray[Any]]
    descriptor: npt.NDArray[np.float32]


def describe(label_map: npt.NDArray[Any], config: SSRVLADConfig) -> npt.NDArray[np.float32]:
    """The descriptor of one image, ``(H, W)`` integer ids of the label space ``config.labels_as``:
    ``(D,)`` float32 of length 1, ``D = config.length``, 480 by default, or zeros for an empty
    image: for residuals one in which no layer has a keypoint, for harmonics one without layers.
    Another array, and an id outside the label space, are a ValueError."""
    layers = layers_of(label_map, config)
    if config.aggregation == "harmonics":
        return harmonics(layers, config).descriptor
    return residuals([trace(layer, config) for layer in layers], config).descriptor


def layers_of(label_map: npt.NDArray[Any], config: SSRVLADConfig) -> list[Mask]:
    """The eight layers of one image on its working grid; arguments and errors: see `describe`."""
    label_map = np.asarray(label_map)
    if label_map.ndim != 2 or label_map.size == 0 or label_map.dtype.kind not in "iu":
        raise ValueError(
            f"expected an (H, W) label map of integers, got {label_map.shape} {label_map.dtype}"
        )
    space = label_space(config.labels_as)
    categories: Integers = np.full(label_map.shape, -1, np.int64)
    for label in space.classes:
        categories[label_map == label.id] = label.category_index  # Table II, or NO_LAYER
    if len(unknown := label_map[categories < 0]):
        raise ValueError(f"label id {unknown.min()} is not in label space {space.name}")
    categories = reduce_by_majority(categories, config.grid(*categories.shape))
    return [categories == k for k in range(CATEGORY_COUNT)]


def trace(layer: Mask, config: SSRVLADConfig) -> LayerTrace:
    """One layer of the paper, from its pixels to its keypoints: opened, closed, small enclosed
    holes filled, small regions dropped, thinned."""
    opening = config.radius_pixels(config.opening, *layer.shape)
    closing = config.radius_pixels(config.closing, *layer.shape)
    clean = dilate(erode(layer, opening), opening)
    clean = erode(dilate(clean, closing), closing)
    clean = clean | small_holes(clean, config.area_pixels(config.hole_area, *layer.shape))
    clean = clean & ~small_regions(clean, config.area_pixels(config.region_area, *layer.shape))
    skeleton = thin(clean, config.thinning)
    keypoints = end_points(skeleton), intersections(skeleton)
    return LayerTrace(layer, clean, skeleton, *keypoints, centroid(clean))


def residuals(traces: list[LayerTrace], config: SSRVLADConfig) -> Description:
    """The paper's aggregation: the vectors V(k) of all layers, concatenated and normalised."""
    limits = config.ring_limits(*traces[0].layer.shape)
    around_centre = np.zeros((len(traces), config.rings, config.sectors), np.int64)
    around_points = np.zeros_like(around_centre)
    vectors = []
    for k, layer in enumerate(traces):
        points = np.argwhere(layer.end_points | layer.intersections)
        context = np.argwhere(layer.skeleton) if config.context == "skeleton" else points
        if layer.centre is not None:
            around_centre[k] = shape_context(layer.centre, context, limits, config.sectors)
        for point in points:
            around_points[k] += shape_context(point, context, limits, config.sectors)
        residual = around_points[k] - len(points) * around_centre[k]  # Eq. 2
        vectors.append(normalise(residual.ravel().astype(np.float64)))
    descriptor = normalise(np.concatenate(vectors)).astype(np.float32)
    return Description({"points": around_points, "centre": around_centre}, descriptor)


def harmonics(layers: list[Mask], config: SSRVLADConfig) -> Description:
    """Areas and boundary directions around the anchor, as coefficients of smooth functions."""
    layers = merge(layers)
    shift = vanishing_column(layers) if config.anchor == "vanishing-column" else 0
    side = min(layers[0].shape) / CELLS[0]
    cells = [pool(layer, shift) for layer in layers]
    cells += [pool(mask, shift) * side / 2 for mask in boundaries(layers)]  # two pixels wide
    histograms = [np.sqrt(soft_histogram(cell, config)) for cell in cells]
    coefficients = []
    for k, histogram in enumerate(histograms):
        count = config.harmonics if k < AREA_LAYERS else config.boundary_harmonics
        coefficients += [(function * histogram).sum() for function in basis(config, count)]
    vector = np.array(coefficients)  # to a power next, but for those close to zero
    vector = vector * ((vector / FAINT) ** 2 + 1) ** ((config.power - 1) / 2)
    return Description({"bins": np.stack(histograms)}, normalise(vector).astype(np.float32))


def merge(layers: list[Mask]) -> list[Mask]:
    """Six layers from eight: guard rail (6) counts as building (2), parking (7) as ground (0)."""
    ground, sidewalk, building, pole, vegetation, sky, rail, parking = layers
    return [ground | parking, sidewalk, building | rail, pole, vegetation, sky]


def boundaries(layers: list[Mask]) -> list[Mask]:
    """Pixels on a boundary of any layer: upright, level, rising to the right, falling.

    The four diagonal neighbours of a pixel decide. Two adjacent ones in the layer make a straight
    boundary; one or three make a slanting one, at the odd neighbour. Pixels at the edge have none.
    """
    height, width = layers[0].shape
    masks = [np.zeros((height, width), bool) for _ in range(4)]
    upright, level, rising, falling = (mask[1:-1, 1:-1] for mask in masks)
    for layer in layers:
        nw, ne, sw, se = layer[:-2, :-2], layer[:-2, 2:], layer[2:, :-2], layer[2:, 2:]
        count = np.sum([nw, ne, sw, se], axis=0)
        upright |= (count == 2) & (nw == sw)
        level |= (count == 2) & (nw == ne)
        for odd in (count == 1, count == 3):
            on = count == 1
            rising |= odd & ((nw == on) | (se == on))
            falling |= odd & ((ne == on) | (sw == on))
    return masks


def reduce_by_majority(categories: Integers, grid: tuple[int, int]) -> Integers:
    """The most common category of each cell; of equally common ones, the lowest."""
    height, width = categories.shape
    row = np.arange(height) * grid[0] // height
    column = np.arange(width) * grid[1] // width
    reduced = np.empty(grid, np.int64)
    for y in range(grid[0]):
        strip = categories[row == y]
        for x in range(grid[1]):
            reduced[y, x] = np.bincount(strip[:, column == x].ravel(), minlength=NO_LAYER).argmax()
    return reduced


def dilate(layer: Mask, radius: int) -> Mask:
    """Dilation by a square of ``2 * radius + 1`` pixels; those outside the image are ignored."""
    square = morphology.footprint_rectangle((2 * radius + 1, 2 * radius + 1))
    return np.asarray(morphology.dilation(layer, square, mode="ignore"), bool)


def erode(layer: Mask, radius: int) -> Mask:
    """Erosion, the dilation of the background."""
    return ~dilate(~layer, radius)


def small_holes(layer: Mask, area: int) -> Mask:
    """4-connected background regions of fewer than ``area`` pixels that touch no border."""
    enclosed = segmentation.clear_border(measure.label(~layer, connectivity=1)) > 0
    return small_regions(enclosed, area, connectivity=1)


def small_regions(layer: Mask, area: int, connectivity: int = 2) -> Mask:
    """Regions of fewer than ``area`` pixels, by default 8-connected."""
    options: dict[str, Any] = {"max_size": max(0, area - 1), "connectivity": connectivity}
    return np.asarray(layer & ~morphology.remove_small_objects(layer, **options))


def neighbours(mask: Mask) -> list[Mask]:
    """p2 ... p9 of the thinning papers: N, NE, E, SE, S, SW, W, NW; outside is background."""
    height, width = mask.shape
    padded = np.pad(mask, 1)
    offsets = [(0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0)]
    return [padded[y : y + height, x : x + width] for y, x in offsets]


def thin(layer: Mask, variant: str) -> Mask:
    """The skeleton by a named variant. ``"guo-hall"`` is ``skimage.morphology.thin``, whose two
    tables are algorithm A1 of Guo & Hall, CACM 32(3), 1989."""
    return zhang_suen(layer) if variant == "zhang-suen" else np.asarray(morphology.thin(layer))


def zhang_suen(layer: Mask) -> Mask:
    """Zhang & Suen, A fast parallel algorithm for thinning digital patterns, CACM 27(3), 1984.

    ``skimage.morphology.skeletonize(method="zhang")`` deletes more patterns than the paper."""
    while True:
        before = layer
        for first in (True, False):
            ring = neighbours(layer)
            p2, _, p4, _, p6, _, p8, _ = ring
            steps, on = crossing_number(ring), np.sum(ring, axis=0)  # A(P1), B(P1)
            products = p4 & p6 & (p2 | p8) if first else p2 & p8 & (p4 | p6)
            layer = layer & ~((on >= 2) & (on <= 6) & (steps == 1) & ~products)
        if (layer == before).all():
            return layer


def crossing_number(ring: list[Mask]) -> Integers:
    """How often the neighbours change from off to on, once around the pixel (Rutovitz)."""
    steps = [~mask & following for mask, following in zip(ring, ring[1:] + ring[:1], strict=True)]
    return np.asarray(np.sum(steps, axis=0))


def end_points(skeleton: Mask) -> Mask:
    """Skeleton pixels with at most one 8-neighbour."""
    return np.asarray(skeleton & (np.sum(neighbours(skeleton), axis=0) <= 1))


def intersections(skeleton: Mask) -> Mask:
    """Skeleton pixels with crossing number 3 or more, except those with another W, NW, N or NE."""
    crossing = skeleton & (crossing_number(neighbours(skeleton)) >= 3)
    north, northeast, _, _, _, _, west, northwest = neighbours(crossing)
    return crossing & ~(west | northwest | north | northeast)


def centroid(layer: Mask) -> tuple[int, int] | None:
    """Row and column of the centre of the layer's pixels (Eq. 1), halves rounded up."""
    pixels, count = np.argwhere(layer), int(layer.sum())
    if not count:
        return None
    row, column = ((2 * pixels.sum(0) + count) // (2 * count)).tolist()
    return row, column


def shape_context(
    point: tuple[int, int] | Integers, context: Integers, limits: tuple[int, ...], sectors: int
) -> Integers:
    """Counts of the context points around a point, ``(N, M)``; the point itself is not counted.

    Ring ``n`` ends at squared distance ``limits[n]``, included. Sector ``m`` begins at the angle
    ``2 pi m / M``, included, counted from +x (right) towards +y (down). The added 1e-12 is far
    below the angle between a boundary and any integer offset that is not on it."""
    dy, dx = (context - np.asarray(point)).T
    squared = dy**2 + dx**2
    ring, turn = np.searchsorted(limits, squared), np.arctan2(dy, dx) / (2 * np.pi)
    sector = np.floor(turn * sectors + 1e-12).astype(np.int64) % sectors
    counted = (squared > 0) & (ring < len(limits))
    histogram = np.zeros((len(limits), sectors), np.int64)
    np.add.at(histogram, (ring[counted], sector[counted]), 1)
    return histogram


def vanishing_column(layers: list[Mask]) -> int:
    """Columns from the middle of the image to where ground, sidewalk and sky are tallest.

    It is a weighted mean. The weight of a column is the eighth power of its open pixels in 64ths
    of its height, 2 ** 20 for a fully open column. The middle of the image has the weight of a
    twentieth of all columns, fully open. Halves are rounded up."""
    height, width = layers[0].shape
    open_pixels = (layers[0] | layers[1] | layers[5]).sum(0)
    weights = [(int(pixels) * 64 // height) ** 8 // 2**28 for pixels in open_pixels]
    moment = sum(weight * (2 * x - (width - 1)) for x, weight in enumerate(weights))
    total = sum(weights) + width * 2**20 // 20
    return int((moment + total) // (2 * total))


def pool(layer: Mask, shift: int) -> Floats:
    """The fraction of each cell that a layer covers after it is moved ``shift`` columns left."""
    height, width = layer.shape
    rows, columns = overlaps(height, CELLS[0], 0), overlaps(width, CELLS[1], shift)
    return np.asarray(rows.T @ layer.astype(np.int64) @ columns / layer.size)


def overlaps(pixels: int, cells: int, shift: int) -> Integers:
    """How much of each pixel lies in each cell, in ``1 / (pixels * cells)`` of a side."""
    start, cell = (np.arange(pixels)[:, None] - shift) * cells, np.arange(cells) * pixels
    shared = np.minimum(start + cells, cell + pixels) - np.maximum(start, cell)
    return np.asarray(np.maximum(shared, 0))


def soft_histogram(cells: Floats, config: SSRVLADConfig) -> Floats:
    """The mean of the cells in each soft bin, ``(N, M)``; bins without cells are 0."""
    weights = soft_bins(config)
    totals = weights.sum((0, 1))
    return np.asarray(np.tensordot(cells, weights, 2) / np.where(totals > 0, totals, 1))


@lru_cache(maxsize=8)
def soft_bins(config: SSRVLADConfig) -> Floats:
    """The weight of each cell in each ring and sector, ``(rows, columns, N, M)``.

    Each cell is sampled at 4 x 4 points. A point between two ring centres (in the logarithm of the
    distance) and two sector centres counts in all four bins, linearly. Inside the centre of the
    first ring it counts in that ring only; beyond the radius it does not count."""
    rows, columns = CELLS
    weights = np.zeros((rows, columns, config.rings, config.sectors))
    for sy, sx in np.ndindex(rows * 4, columns * 4):
        dy, dx = (sy + 0.5) / 4 - rows / 2, (sx + 0.5) / 4 - columns / 2
        distance = math.hypot(dy, dx) / math.hypot(rows, columns) / config.radius
        ring = 0.0
        if config.rings > 1 and config.inner_radius < 1:
            steps = math.log(distance) / math.log(1 / config.inner_radius)
            ring = max(0.0, (config.rings - 1) * (1 + steps))
        sector = math.atan2(dy, dx) / (2 * math.pi) * config.sectors
        for one, other in np.ndindex(2, 2):
            n, m = math.floor(ring) + one, math.floor(sector) + other
            if distance <= 1 and n < config.rings:
                linear = (1 - abs(ring - n)) * (1 - abs(sector - m))
                weights[sy // 4, sx // 4, n, m % config.sectors] += linear
    return weights


@lru_cache(maxsize=8)
def basis(config: SSRVLADConfig, count: int) -> list[Floats]:
    """The ``count`` smoothest functions over the bins, ``(N, M)`` each; finer ones weigh more."""
    waves = [
        (u * u + v * v, u, v, sine)
        for u, v in np.ndindex(config.rings, (config.sectors + 1) // 2)
        for sine in ((False, True) if v else (False,))
    ]
    functions = []
    for squared, u, v, sine in sorted(waves)[:count]:
        rings = np.cos(np.pi * u * (np.arange(config.rings) + 0.5) / config.rings)
        turns = 2 * np.pi * v * np.arange(config.sectors) / config.sectors
        function = np.outer(rings, np.sin(turns) if sine else np.cos(turns))
        functions.append(normalise(function) * (1 + squared) ** (config.spectral_weight / 2))
    return functions


def normalise(vector: Floats) -> Floats:
    """The vector divided by its L2 norm; zeros stay zeros."""
    norm = np.linalg.norm(vector)
    return vector / norm if norm > 0 else vector


def features(activations: list[Floats], noise: list[list[Floats]]) -> npt.NDArray[np.uint8]:
    """The signs ``(16, 16, 16)`` of one picture, see `stages.features.Features`, from activations
    ``(C, h, w)``, and from those of each of some pictures of noise."""
    projections = projections_of([unit_cells(level) for level in noise])
    positive = unit_cells(activations).transpose(2, 1, 0) @ projections > 0
    return np.packbits(positive, axis=2, bitorder="little")


def unit_cells(activations: list[Floats]) -> Floats:
    """The cells ``(sum of C, 16, 16)`` of the activations of one picture."""
    parts = []
    for activation in activations:
        height, width = activation.shape[1:]
        down, across = overlaps(height, SIDE, 0) / height, overlaps(width, SIDE, 0) / width
        means = [down.T @ channel @ across for channel in activation]
        cells = np.array(
            [(level - level.mean()) / math.sqrt(level.var() + 1e-5) for level in means]
        )
        around = np.zeros_like(cells)
        for row, column in np.ndindex(SIDE, SIDE):
            near = [slice(max(0, at - 2), at + 3) for at in (row, column)]
            around[:, row, column] = cells[:, *near].mean((1, 2))
        cells -= around / 2
        parts.append(cells / np.maximum(np.linalg.norm(cells, axis=0), 1e-12))
    return np.concatenate(parts)


def projections_of(noise: list[Floats]) -> Floats:
    """By which a cell is projected, ``(C, 128)``, from the cells of pictures of noise."""
    flat = np.concatenate([level.reshape(len(level), -1) for level in noise], 1)
    variances, components = np.linalg.eigh(flat @ flat.T / flat.shape[1])
    large = [k for k in np.argsort(-variances)[:SIGNS] if variances[k] > 1e-4 * variances.max()]
    components, deviations = components[:, large], np.sqrt(variances[large])
    sides = np.array([random_side(n) for n in range(SIGNS * len(flat))]).reshape(SIGNS, -1)
    left, _, right = np.linalg.svd((sides @ components).T, full_matrices=False)
    projections: Floats = components / deviations @ left @ right
    return projections


def random_side(number: int) -> int:
    """1 or -1 by the highest bit of SplitMix64 after ``number + 1`` steps from state 0."""
    state = (number + 1) * 0x9E3779B97F4A7C15 % 2**64
    state = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    state = (state ^ state >> 27) * 0x94D049BB133111EB % 2**64
    return -1 if (state ^ state >> 31) >> 63 else 1
