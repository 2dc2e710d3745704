"""The front end of the method: label map -> layers -> clean layers -> skeletons."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .bitplanes import Masks
from .config import SSRVLADConfig
from .stages.components import drop_regions, fill_holes
from .stages.layers import best_class, categorise, category_table, refuse_unknown, split
from .stages.morphology import open_and_close
from .stages.reduction import reduce_by_majority
from .stages.skeleton import RULES, thin
from .taxonomy import LabelSpace, label_space

PIXELS_AT_ONCE = 1 << 20
"""Label map pixels in memory at a time on their way to the working grid."""


class FrontEnd(nn.Module):
    """Label maps or class scores -> the masks of the eight layers, on the working grid.

    Args:
        config: the settings.

    Shape:
        - input: ``(B, H, W)`` label ids or ``(B, C, H, W)`` class scores, as for `SSRVLAD`.
        - output: `Masks` of ``(B, h, w)`` uint8 bit-planes.

    Raises:
        ValueError: input that `SSRVLAD` refuses.
    """

    def __init__(self, config: SSRVLADConfig) -> None:
        super().__init__()
        self.config = config
        self.label_space = label_space(config.labels_as)
        self.table: Tensor
        table, self.origin = category_table(self.label_space)
        self.register_buffer("table", table, persistent=False)

    def forward(self, labels: Tensor) -> Masks:
        """The masks of a batch."""
        labels = label_map(labels, self.label_space)
        config, grid = self.config, self.config.grid(*labels.shape[1:])
        opening = config.radius_pixels(config.opening, *grid)
        closing = config.radius_pixels(config.closing, *grid)

        layers = split(self._categories(labels, grid))  # Table II
        closed = open_and_close(layers, opening, closing)
        filled = fill_holes(closed, config.area_pixels(config.hole_area, *grid))
        clean = drop_regions(filled, config.area_pixels(config.region_area, *grid))
        return Masks(layers, closed, clean, thin(clean, RULES[config.thinning]))

    def _categories(self, labels: Tensor, grid: tuple[int, int]) -> Tensor:
        """Categories on the working grid, a few images at a time so that memory stays bounded."""
        table = self.table.to(labels.device)
        images_at_once = max(1, PIXELS_AT_ONCE // labels[0].numel())
        reduced = []
        for part in labels.split(images_at_once):
            categories = categorise(part, table, self.origin)
            refuse_unknown(labels, categories, self.label_space)
            reduced.append(reduce_by_majority(categories, grid))
        return torch.cat(reduced)


def label_map(labels: Tensor, space: LabelSpace) -> Tensor:
    """The label map of checked input: the class of the highest score where it is class scores."""
    got = f"got {tuple(labels.shape)} {str(labels.dtype).removeprefix('torch.')}"
    if labels.ndim == 3 and (labels.is_floating_point() or labels.dtype == torch.bool):
        raise ValueError(f"a (B, H, W) label map must hold integer ids, {got}")
    if labels.ndim == 4 and not labels.is_floating_point():
        raise ValueError(f"(B, C, H, W) class scores must be floating point, {got}")
    if labels.ndim not in (3, 4) or labels.is_complex():
        raise ValueError(f"expected (B, H, W) label ids or (B, C, H, W) class scores, {got}")
    if labels.numel() == 0:
        raise ValueError(f"expected at least one image of at least one pixel, {got}")
    if labels.ndim == 3:
        return labels
    expected = space.channel_counts
    if labels.shape[1] not in expected:
        counts = " or ".join(map(str, expected)) or "no class scores, its ids have gaps"
        raise ValueError(
            f"class scores have {labels.shape[1]} classes; label space {space.name} takes {counts}"
        )
    return best_class(labels)
