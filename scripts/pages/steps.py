"""The preset `default` from masks with any settings, and rejected variants of its steps.

`ablate.py` and `shape.py` measure them. The package does not use them.
"""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F
from conditions import Describe, Drive, Masks, described_from_masks
from torch import Tensor

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.bitplanes import count_points, pack, points, unpack
from ssrvlad_torch.config import AREA_LAYERS
from ssrvlad_torch.stages.boundaries import WIDTH, boundaries
from ssrvlad_torch.stages.centroid import centre_table, centroids
from ssrvlad_torch.stages.grid_pooling import CELLS, ROWS, pool
from ssrvlad_torch.stages.harmonics import (
    Harmonics,
    basis_table,
    bin_table,
    coefficients,
    damped,
    harmonic_tables,
    soft_histograms,
)
from ssrvlad_torch.stages.keypoints import end_points, intersections
from ssrvlad_torch.stages.layers import merge
from ssrvlad_torch.stages.residuals import aggregate
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts
from ssrvlad_torch.stages.vanishing_column import vanishing_columns
from ssrvlad_torch.taxonomy import NO_LAYER

DEFAULT = SSRVLADConfig()
NUMBERS = DEFAULT.harmonics, DEFAULT.boundary_harmonics
PAPER = SSRVLADConfig.from_preset("paper")
IMAGES_AT_ONCE = 16


def harmonics(config: SSRVLADConfig) -> Describe:
    """The preset `default` with other settings for the stages after the layers."""
    made = Harmonics(config)
    return described_from_masks(lambda masks: made.descriptor(made.histograms(categories(masks))))


def area_alone(masks: Masks) -> Tensor:
    """All 480 numbers for the areas of the six layers."""
    return described(cells(masks), (80, 0))


def with_merged(kept: int, other: int, masks: Masks) -> Tensor:
    """Merges the area of one layer into another layer."""
    found = cells(masks).clone()
    found[:, kept] += found[:, other]
    found[:, other] = 0
    return described(found)


def weighted_by_agreement(describe: Describe) -> Describe:
    """Each number weighs by how slowly it changes along the drive, which needs no truth.

    The weight is 1 less half the mean square of its steps over its variance: 1 for what changes
    steadily, 0 for what is drawn anew in every frame. A product of two drives' numbers weighs by
    the root of both weights.
    """

    def weighted(drive: Drive) -> Tensor:
        single = describe(drive)
        steps = single.diff(dim=0).square().mean(0) / 2
        agreement = (1 - steps / (single.var(0) + 1e-9)).clamp(0.01, 1)
        return F.normalize(single * agreement.sqrt())

    return weighted


def between_labelled_pixels(masks: Masks) -> Tensor:
    """Counts boundaries only where all four diagonal neighbours are in a layer."""
    layers = numbers(masks)
    known = F.pad((layers < AREA_LAYERS).to(torch.uint8), (1, 1, 1, 1))
    height, width = layers.shape[1:]
    whole = torch.ones_like(layers)
    for y, x in ((0, 0), (0, 2), (2, 0), (2, 2)):
        whole &= known[:, y : y + height, x : x + width]
    return described(with_lengths(masks, boundaries(layers) * whole[:, None]))


def with_boundaries_of_each_layer(masks: Masks, of_area: int, of_boundaries: int) -> Tensor:
    """Boundary directions of buildings, poles, vegetation and sky, one histogram per layer."""
    layers, found = numbers(masks), cells(masks)
    parts = [described_part(found[:, :AREA_LAYERS], of_area)]
    for layer in (2, 3, 4, 5):
        own = with_lengths(masks, boundaries(layers.masked_fill(layers != layer, AREA_LAYERS)))
        parts.append(described_part(own[:, AREA_LAYERS:], of_boundaries))
    return F.normalize(torch.cat(parts, 1)).float()


def described_part(found: Tensor, number: int) -> Tensor:
    """``(B, blocks * number)`` damped coefficients, not yet normalised."""
    bins = harmonic_tables(DEFAULT).bins
    basis = harmonic_tables(DEFAULT).basis[:number]
    held = (soft_histograms(found, bins) @ basis.T).flatten(1)
    return damped(held, DEFAULT.power)


def skeleton_in_place_of_boundaries(masks: Masks) -> Tensor:
    """The lengths of the six skeletons, 16 numbers each, in place of the boundaries."""
    return _with_skeleton(masks, 16, 0)


def skeleton_lengths_too(masks: Masks) -> Tensor:
    """The preset with the lengths of the six skeletons added, 8 numbers each."""
    return _with_skeleton(masks, 8, DEFAULT.boundary_harmonics)


def _with_skeleton(masks: Masks, of_skeleton: int, of_boundaries: int) -> Tensor:
    shift = vanishing_columns(numbers(masks))
    found = cells(masks)
    lengths = pool(unpack(masks.skeleton), shift)[:, :AREA_LAYERS] * _side(masks)
    parts = (
        described_part(found[:, :AREA_LAYERS], DEFAULT.harmonics),
        described_part(found[:, AREA_LAYERS:], of_boundaries),
        described_part(lengths, of_skeleton),
    )
    return F.normalize(torch.cat(parts, 1)).float()


def layers_of_one_length(masks: Masks) -> Tensor:
    """Normalises each layer to the same length, as in the paper."""
    bins, basis = harmonic_tables(DEFAULT)
    held = soft_histograms(cells(masks), bins) @ basis.T
    held = damped(held, DEFAULT.power)
    area = F.normalize(held[:, :AREA_LAYERS], dim=2) / AREA_LAYERS**0.5
    length = held[:, AREA_LAYERS:, : DEFAULT.boundary_harmonics].flatten(1)
    return F.normalize(torch.cat((area.flatten(1), F.normalize(length) / 2), 1)).float()


def residuals(masks: Masks) -> Tensor:
    """The residuals of the paper, on the masks of the preset."""
    return aggregate(*_residuals(masks))


def residuals_with_root_and_area(masks: Masks) -> Tensor:
    """Signed square roots of the residuals, weighted by the root of the layer's area."""
    sums, centres, counts = _residuals(masks)
    held = (sums - counts[..., None] * centres).double()
    layers = F.normalize(held.sign() * held.abs().sqrt(), dim=2)
    area = pool(unpack(masks.clean), _middle(masks)).mean((2, 3)).sqrt()
    return F.normalize((layers * area[..., None]).flatten(1)).float()


def anchored_at_each_layers_centre(masks: Masks) -> Tensor:
    """The soft histogram of each layer around the column of its centroid (Eq. 1)."""
    layers = masks_of(numbers(masks))
    columns = centre_table(centroids(pack(F.pad(layers, (0, 0, 0, 0, 0, 2)))), len(layers))[..., 1]
    shifts = torch.where(columns < 0, 0, columns - (layers.shape[3] - 1) // 2)
    found = cells(masks)
    found = found.clone()
    for k in range(AREA_LAYERS):
        found[:, k] = pool(layers, shifts[:, k])[:, k]
    return described(found)


def dynamic_objects_filled(masks: Masks) -> Tensor:
    """Fills moving objects with the classes around them."""
    found = cells(masks)
    area = found[:, :AREA_LAYERS]
    blurred = F.avg_pool2d(area, 5, 1, 2)
    missing = (1 - area.sum(1, keepdim=True)).clamp(min=0)
    filled = area + missing * blurred / blurred.sum(1, keepdim=True).clamp(min=0.02)
    return described(torch.cat((filled, found[:, AREA_LAYERS:]), 1))


def waves_over_the_picture(masks: Masks) -> Tensor:
    """Cosines over rows and columns (a DCT) in place of harmonics over rings and sectors."""
    found = cells(masks)
    rows, columns = (_cosines(n) for n in found.shape[-2:])
    every = (rows @ found.sqrt() @ columns.T).flatten(2)
    down, across = torch.meshgrid(*(torch.arange(n) for n in found.shape[-2:]), indexing="ij")
    squared = (down**2 + across**2).flatten()
    lowest = squared.argsort(stable=True)[: DEFAULT.harmonics]
    held = every[..., lowest] * (1 + squared[lowest]).double().sqrt()
    area, length = held[:, :AREA_LAYERS], held[:, AREA_LAYERS:, : DEFAULT.boundary_harmonics]
    kept = torch.cat((area.flatten(1), length.flatten(1)), 1)
    return F.normalize(damped(kept, DEFAULT.power)).float()


def plain_bins(masks: Masks) -> Tensor:
    """Square roots of 4 x 12 soft bins of each area and direction, without harmonics."""
    bins = bin_table(CELLS, 4, 12, DEFAULT.radius, DEFAULT.inner_radius)
    return F.normalize(soft_histograms(cells(masks), bins).flatten(1)).float()


REJECTED: dict[str, Describe] = {
    name: described_from_masks(step)
    for name, step in {
        "residuals (Eq. 2)": residuals,
        "residuals, root, area": residuals_with_root_and_area,
        "layers of one length": layers_of_one_length,
        "anchored at each layer's centre": anchored_at_each_layers_centre,
        "dynamic objects filled": dynamic_objects_filled,
        "DCT in place of harmonics": waves_over_the_picture,
        "4 x 12 soft bins, no harmonics": plain_bins,
    }.items()
}


@cache
def cells(masks: Masks) -> Tensor:
    """``(B, 10, rows, columns)`` areas and lengths of boundaries, computed once per drive."""
    return with_lengths(masks, boundaries(numbers(masks)))


def numbers(masks: Masks) -> Tensor:
    """``(B, h, w)``, the number of the merged layer at each pixel."""
    return merge(categories(masks))


def categories(masks: Masks) -> Tensor:
    """``(B, h, w)``, 0 to 7 or `NO_LAYER`."""
    layers = unpack(masks.layers)
    return layers.to(torch.uint8).argmax(1).masked_fill(~layers.any(1), NO_LAYER)


def masks_of(layers: Tensor) -> Tensor:
    """``(B, 6, h, w)`` bool."""
    return layers[:, None] == torch.arange(AREA_LAYERS).view(-1, 1, 1)


def with_lengths(masks: Masks, seen: Tensor) -> Tensor:
    """``(B, 10, rows, columns)`` areas and lengths of boundaries, from masks of directions."""
    layers = numbers(masks)
    shift = vanishing_columns(layers)
    lengths = pool(seen, shift) * (_side(masks) / WIDTH)
    return torch.cat((pool(masks_of(layers), shift), lengths), 1)


def _side(masks: Masks) -> float:
    return min(masks.layers.shape[1:]) / ROWS


def described(found: Tensor, numbers: tuple[int, int] = NUMBERS) -> Tensor:
    """The descriptors of ``(B, 10, rows, columns)`` areas and lengths."""
    bins = harmonic_tables(DEFAULT).bins
    basis = basis_table(DEFAULT.rings, DEFAULT.sectors, max(numbers), DEFAULT.spectral_weight)
    return coefficients(soft_histograms(found, bins), basis, numbers, DEFAULT.power)


def _middle(masks: Masks) -> Tensor:
    return torch.zeros(len(masks.clean), dtype=torch.int64)


def _residuals(masks: Masks) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of the keypoints' histograms, the centres' histograms, numbers of keypoints."""
    grid, found = masks.clean.shape[1:], []
    bins = log_polar_bins(*grid, PAPER.ring_limits(*grid), PAPER.sectors, masks.clean.device)
    parts = (plane.split(IMAGES_AT_ONCE) for plane in (masks.clean, masks.skeleton))
    for clean, skeleton in zip(*parts, strict=True):
        keypoints, images = points(end_points(skeleton) | intersections(skeleton)), len(clean)
        around = [
            shape_contexts(where, points(skeleton), bins, images)
            for where in (keypoints, centroids(clean))
        ]
        found.append((*around, count_points(keypoints, images)))
    sums, centres, counts = (torch.cat(column) for column in zip(*found, strict=True))
    return sums, centres, counts


def _cosines(count: int) -> Tensor:
    index = torch.arange(count).double()
    table = torch.cos(torch.pi * index[:, None] * (index + 0.5) / count)
    return F.normalize(table, dim=1)
