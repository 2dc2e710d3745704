"""Steps that were tried for the preset `default` and not kept, each as a way to describe a drive.

They stand here so that `ablate.py` can measure them again; nothing of the package uses them.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from conditions import BATCH, Describe, Drive
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.bitplanes import pack
from ssrvlad_torch.descriptor import Explanation
from ssrvlad_torch.stages.canvas import ROWS, shares
from ssrvlad_torch.stages.harmonics import (
    amounts,
    bin_table,
    pattern_table,
    soft_histograms,
)
from ssrvlad_torch.stages.vista import vistas

DEFAULT = SSRVLADConfig()
BINS = bin_table(DEFAULT.rings, DEFAULT.sectors, DEFAULT.radius, DEFAULT.inner_radius)
PATTERNS = pattern_table(DEFAULT.rings, DEFAULT.sectors, DEFAULT.harmonics, DEFAULT.sharpening)

Step = Callable[[Explanation], Tensor]


def from_explanation(step: Step, config: SSRVLADConfig = DEFAULT) -> Describe:
    def describe(drive: Drive) -> Tensor:
        head = SSRVLAD.from_preset("default", **{**config.to_dict(), "labels_as": drive.labels_as})
        batches = torch.from_numpy(drive.maps).split(BATCH)
        return torch.cat([step(head.explain(batch)) for batch in batches])

    return describe


def layer_vectors_of_one_length(view: Explanation) -> Tensor:
    """Every layer weighs the same, as in the paper: a pole as much as the sky."""
    return F.normalize(
        F.normalize(view.descriptor.view(-1, 8, DEFAULT.harmonics), dim=2).flatten(1)
    )


def residuals_with_root_and_area(view: Explanation) -> Tensor:
    """The paper's residuals, signed square root, weighted by the root of the layer's area."""
    points = view.keypoints.sum((2, 3))[..., None, None]
    residuals = (view.point_histograms - points * view.centre_histograms).flatten(2).double()
    layers = F.normalize(residuals.sign() * residuals.abs().sqrt(), dim=2)
    area = view.clean_layers.double().mean((2, 3)).sqrt()
    return F.normalize((layers * area[..., None]).flatten(1)).float()


def anchored_at_each_layers_centre(view: Explanation) -> Tensor:
    """The soft histogram of each layer around its own centroid's column, as Eq. 1 has it."""
    width = view.layers.shape[-1]
    found = []
    for k in range(8):
        column = view.centres[:, k, 1]
        shift = torch.where(column < 0, 0, column - (width - 1) // 2)
        found.append(_histogram(view, shift)[:, k])
    return amounts(torch.stack(found, 1), PATTERNS, DEFAULT.power)


def dynamic_objects_filled(view: Explanation) -> Tensor:
    """What cars and people hide is filled with what stands around it."""
    vista = vistas(pack(view.clean_layers))
    area = shares(pack(view.layers), vista)
    blurred = F.avg_pool2d(area, 5, 1, 2)
    known = blurred.sum(1, keepdim=True)
    missing = (1 - area.sum(1, keepdim=True)).clamp(min=0)
    filled = area + missing * blurred / known.clamp(min=0.02)
    lengths = shares(pack(view.skeleton), vista) * (min(view.layers.shape[-2:]) / ROWS)
    histogram = soft_histograms(filled, lengths, DEFAULT.skeleton_weight, BINS)
    return amounts(histogram, PATTERNS, DEFAULT.power)


def waves_over_the_picture(view: Explanation) -> Tensor:
    """Cosines over rows and columns (a DCT) in place of harmonics over rings and sectors."""
    area = shares(pack(view.layers), vistas(pack(view.clean_layers))).sqrt()
    rows, columns = (_cosines(n) for n in area.shape[-2:])
    every = rows @ area @ columns.T
    squared = (
        torch.arange(every.shape[2])[:, None] ** 2 + torch.arange(every.shape[3]) ** 2
    ).flatten()
    lowest = squared.argsort(stable=True)[: DEFAULT.harmonics]
    held = every.flatten(2)[..., lowest] * (1 + squared[lowest]).double().sqrt()
    return F.normalize((held.sign() * held.abs() ** DEFAULT.power).flatten(1)).float()


def plain_bins(view: Explanation) -> Tensor:
    """Square-rooted soft bins themselves, 5 x 12 of them, without harmonics."""
    bins = bin_table(5, 12, DEFAULT.radius, DEFAULT.inner_radius)
    vista = vistas(pack(view.clean_layers))
    area = shares(pack(view.layers), vista)
    return F.normalize((area.flatten(2) @ bins.T).sqrt().flatten(1)).float()


REJECTED: dict[str, Describe] = {
    "paper's residuals, root, area": from_explanation(
        residuals_with_root_and_area, SSRVLADConfig.from_preset("paper", working_size=120)
    ),
    "layers of one length": from_explanation(layer_vectors_of_one_length),
    "anchored at each layer's centre": from_explanation(anchored_at_each_layers_centre),
    "dynamic objects filled": from_explanation(dynamic_objects_filled),
    "DCT in place of harmonics": from_explanation(waves_over_the_picture),
    "5 x 12 soft bins, no harmonics": from_explanation(plain_bins),
}


def _histogram(view: Explanation, shift: Tensor) -> Tensor:
    area, lengths = (shares(pack(mask), shift) for mask in (view.layers, view.skeleton))
    lengths = lengths * (min(view.layers.shape[-2:]) / ROWS)
    return soft_histograms(area, lengths, DEFAULT.skeleton_weight, BINS)


def _cosines(count: int) -> Tensor:
    index = torch.arange(count).double()
    table = torch.cos(torch.pi * index[:, None] * (index + 0.5) / count)
    return F.normalize(table, dim=1)
