"""The preset `default` from its masks with any settings, and the steps that were not kept.

They stand here so that `ablate.py` can measure them again; nothing of the package uses them.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from conditions import Describe, Masks, described_from_masks
from torch import Tensor

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.bitplanes import count_points, points
from ssrvlad_torch.stages.centroid import centre_table, centroids
from ssrvlad_torch.stages.grid_pooling import CELLS, ROWS, pool
from ssrvlad_torch.stages.harmonics import (
    bin_table,
    coefficients,
    harmonic_tables,
    soft_histograms,
)
from ssrvlad_torch.stages.keypoints import end_points, intersections
from ssrvlad_torch.stages.residuals import aggregate
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts
from ssrvlad_torch.stages.vanishing_column import vanishing_columns

DEFAULT = SSRVLADConfig()
PAPER = SSRVLADConfig.from_preset("paper")
IMAGES_AT_ONCE = 16


def harmonics(config: SSRVLADConfig) -> Describe:
    """The preset `default` with other settings behind its masks."""
    bins, basis = harmonic_tables(config)

    def step(masks: Masks) -> Tensor:
        anchor = (
            vanishing_columns(masks.clean)
            if config.anchor == "vanishing-column"
            else _middle(masks)
        )
        area, lengths = _cells(masks, anchor)
        histogram = soft_histograms(area, lengths, config.skeleton_weight, bins)
        return coefficients(histogram, basis, config.power)

    return described_from_masks(step)


def layers_of_one_length(masks: Masks) -> Tensor:
    """Every layer weighs the same, as in the paper: a pole as much as the sky."""
    bins, basis = harmonic_tables(DEFAULT)
    area, lengths = _cells(masks, vanishing_columns(masks.clean))
    histogram = soft_histograms(area, lengths, DEFAULT.skeleton_weight, bins)
    blocks = coefficients(histogram, basis, DEFAULT.power).unflatten(1, (8, -1))
    return F.normalize(F.normalize(blocks, dim=2).flatten(1))


def residuals(masks: Masks) -> Tensor:
    """The paper's residuals, on the preset's masks."""
    return aggregate(*_residuals(masks))


def residuals_with_root_and_area(masks: Masks) -> Tensor:
    """The same, signed square root, weighted by the root of the layer's area."""
    sums, centres, counts = _residuals(masks)
    held = (sums - counts[..., None] * centres).double()
    layers = F.normalize(held.sign() * held.abs().sqrt(), dim=2)
    area = pool(masks.clean, _middle(masks)).mean((2, 3)).sqrt()
    return F.normalize((layers * area[..., None]).flatten(1)).float()


def anchored_at_each_layers_centre(masks: Masks) -> Tensor:
    """The soft histogram of each layer around its own centroid's column, as Eq. 1 has it."""
    bins, basis = harmonic_tables(DEFAULT)
    columns = centre_table(centroids(masks.clean), len(masks.clean))[..., 1]
    shifts = torch.where(columns < 0, 0, columns - (masks.clean.shape[2] - 1) // 2)
    found = []
    for k in range(8):
        area, lengths = (cells[:, k : k + 1] for cells in _cells(masks, shifts[:, k]))
        found.append(soft_histograms(area, lengths, DEFAULT.skeleton_weight, bins))
    return coefficients(torch.cat(found, 1), basis, DEFAULT.power)


def dynamic_objects_filled(masks: Masks) -> Tensor:
    """What cars and people hide is filled with what stands around it."""
    bins, basis = harmonic_tables(DEFAULT)
    area, lengths = _cells(masks, vanishing_columns(masks.clean))
    blurred = F.avg_pool2d(area, 5, 1, 2)
    missing = (1 - area.sum(1, keepdim=True)).clamp(min=0)
    filled = area + missing * blurred / blurred.sum(1, keepdim=True).clamp(min=0.02)
    histogram = soft_histograms(filled, lengths, DEFAULT.skeleton_weight, bins)
    return coefficients(histogram, basis, DEFAULT.power)


def waves_over_the_picture(masks: Masks) -> Tensor:
    """Cosines over rows and columns (a DCT) in place of harmonics over rings and sectors."""
    area, _ = _cells(masks, vanishing_columns(masks.clean))
    rows, columns = (_cosines(n) for n in area.shape[-2:])
    every = (rows @ area.sqrt() @ columns.T).flatten(2)
    down, across = torch.meshgrid(*(torch.arange(n) for n in area.shape[-2:]), indexing="ij")
    squared = (down**2 + across**2).flatten()
    lowest = squared.argsort(stable=True)[: DEFAULT.harmonics]
    held = every[..., lowest] * (1 + squared[lowest]).double().sqrt()
    return F.normalize((held.sign() * held.abs() ** DEFAULT.power).flatten(1)).float()


def plain_bins(masks: Masks) -> Tensor:
    """Square-rooted soft bins themselves, 5 x 12 of them, without harmonics."""
    bins = bin_table(CELLS, 5, 12, DEFAULT.radius, DEFAULT.inner_radius)
    area, _ = _cells(masks, vanishing_columns(masks.clean))
    return F.normalize((area.flatten(2) @ bins.T).sqrt().flatten(1)).float()


REJECTED: dict[str, Describe] = {
    name: described_from_masks(step)
    for name, step in {
        "residuals (Eq. 2)": residuals,
        "residuals, root, area": residuals_with_root_and_area,
        "layers of one length": layers_of_one_length,
        "anchored at each layer's centre": anchored_at_each_layers_centre,
        "dynamic objects filled": dynamic_objects_filled,
        "DCT in place of harmonics": waves_over_the_picture,
        "5 x 12 soft bins, no harmonics": plain_bins,
    }.items()
}


def _cells(masks: Masks, shift: Tensor) -> tuple[Tensor, Tensor]:
    lengths = pool(masks.skeleton, shift) * (min(masks.skeleton.shape[1:]) / ROWS)
    return pool(masks.layers, shift), lengths


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
