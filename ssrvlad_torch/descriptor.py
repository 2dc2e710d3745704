"""The method: label map -> layers -> skeletons -> key-points -> histograms -> 480 numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor, nn

from .bitplanes import count_points, points, unpack
from .config import SSRVLADConfig
from .stages.canvas import CELLS, ROWS, shares
from .stages.centroid import centre_table, centroids
from .stages.components import drop_regions, fill_holes
from .stages.harmonics import amounts, bin_table, pattern_table, soft_histograms
from .stages.keypoints import end_points, intersections
from .stages.layers import categorise, category_table, refuse_unknown, split
from .stages.morphology import open_and_close
from .stages.reduction import reduce_by_majority
from .stages.residuals import aggregate
from .stages.shape_context import log_polar_bins, shape_contexts
from .stages.skeleton import RULES, sweep_into, thin, thin_by_sweeps
from .stages.vista import vistas
from .taxonomy import LabelSpace, label_space

PIXELS_AT_ONCE = 1 << 20
"""Label map pixels in memory at a time on their way to the working grid."""


class SSRVLAD(nn.Module):
    """Label maps or class scores -> place descriptors (Nie, Feng et al., arXiv 2202.03677).

    The module has no weights and needs no training. It runs where its input lies, on CPU or
    CUDA, and counts the same integers on both. ``head.compile()`` fuses the thinning, which
    takes most of the time.

    Args:
        config: the settings; without, the preset ``default``.
        surrogate: give class scores that require a gradient that of `SoftSSRVLAD`; the numbers
            stay the same.

    Shape:
        - input: ``(B, H, W)`` label ids of any integer dtype, or ``(B, C, H, W)`` floating class
          scores (logits or probabilities; the largest wins, the first of equals), any ``H`` and
          ``W`` from 1.
        - output: ``(B, 480)`` float32 of length 1, or exact zeros for an empty image, in which
          no category has a key-point.

    Raises:
        ValueError: wrong rank or dtype, an empty batch or image, an id outside the label space,
            NaN scores, or a class count that does not fit the label space. The message names
            the offender, what was got and what was wanted.

    Example:
        >>> head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
        >>> head(torch.zeros(2, 240, 320, dtype=torch.uint8)).shape
        torch.Size([2, 480])
    """

    def __init__(self, config: SSRVLADConfig | None = None, surrogate: bool = False) -> None:
        super().__init__()
        self.config = config or SSRVLADConfig()
        self.label_space = label_space(self.config.labels_as)
        table, self._origin = category_table(self.label_space)
        self._table: Tensor
        self.register_buffer("_table", table, persistent=False)
        self._bins, self._patterns = _tables(self.config)
        self._thin: Callable[[Tensor], Tensor] = partial(thin, rule=RULES[self.config.thinning])
        self._twin = _twin(self.config) if surrogate else None

    @classmethod
    def from_preset(cls, preset: str, surrogate: bool = False, **settings: Any) -> SSRVLAD:
        """The head of a preset, ``"paper"`` or ``"default"``; see `SSRVLADConfig.from_preset`."""
        return cls(SSRVLADConfig.from_preset(preset, **settings), surrogate)

    def forward(self, labels: Tensor, explained: bool = False) -> Tensor | Explanation:
        """The descriptors of a batch, or all that led to them if they are to be ``explained``."""
        if torch.is_autocast_enabled(labels.device.type):
            with torch.autocast(labels.device.type, enabled=False):
                return self.forward(labels, explained)
        if self._twin and labels.requires_grad and torch.is_grad_enabled():
            view = self.explain(labels.detach())
            return view if explained else view.descriptor + _zeros_of(self._twin(labels, view))
        labels = _label_map(labels, self.label_space)
        config = self.config
        grid = config.grid(*labels.shape[1:])

        layers = split(self._categories(labels, grid))  # Table II
        clean = open_and_close(
            layers,
            config.radius_pixels(config.opening, *grid),
            config.radius_pixels(config.closing, *grid),
        )
        clean = fill_holes(clean, config.area_pixels(config.hole_area, *grid))
        clean = drop_regions(clean, config.area_pixels(config.region_area, *grid))

        skeleton = self._thin(clean)
        if config.aggregation == "residuals":
            descriptor, histograms = self._residuals(clean, skeleton)
        else:
            descriptor, histograms = self._harmonics(layers, clean, skeleton)
        if not explained:
            return descriptor
        return Explanation(
            layers=unpack(layers),
            clean_layers=unpack(clean),
            skeleton=unpack(skeleton),
            end_points=unpack(end_points(skeleton)),
            intersections=unpack(intersections(skeleton)),
            centres=centre_table(centroids(clean), len(clean)),
            descriptor=descriptor,
            **histograms,
        )

    def _residuals(self, clean: Tensor, skeleton: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The paper's descriptor, and the histograms that led to it."""
        config, (images, *grid) = self.config, clean.shape
        keypoints = points(end_points(skeleton) | intersections(skeleton))
        centres = centroids(clean)  # Eq. 1
        context = points(skeleton) if config.context == "skeleton" else keypoints

        bins = log_polar_bins(*grid, config.ring_limits(*grid), config.sectors, clean.device)
        point_sums = shape_contexts(keypoints, context, bins, images)
        centre_counts = shape_contexts(centres, context, bins, images)
        descriptor = aggregate(point_sums, centre_counts, count_points(keypoints, images))  # Eq. 2
        return descriptor, {
            "point_histograms": self._by_bin(point_sums),
            "centre_histograms": self._by_bin(centre_counts),
        }

    def _harmonics(
        self, layers: Tensor, clean: Tensor, skeleton: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The descriptor around the vista, and the histograms that led to it."""
        config, (images, *grid) = self.config, clean.shape
        middle = torch.zeros(images, dtype=torch.int64, device=clean.device)
        vista = vistas(clean) if config.anchor == "vista" else middle

        area = shares(layers, vista)
        lengths = shares(skeleton, vista) * (min(grid) / ROWS)
        bins, patterns = (table.to(clean.device) for table in (self._bins, self._patterns))
        histogram = soft_histograms(area, lengths, config.skeleton_weight, bins)
        descriptor = amounts(histogram, patterns, config.power)
        return descriptor, {"vista": vista, "vista_histograms": self._by_bin(histogram)}

    def _by_bin(self, histogram: Tensor) -> Tensor:
        return histogram.view(*histogram.shape[:2], self.config.rings, self.config.sectors)

    def explain(self, labels: Tensor) -> Explanation:
        """Every step from the label map to the descriptor; input and errors as for a call."""
        return cast(Explanation, self(labels, explained=True))

    def _categories(self, labels: Tensor, grid: tuple[int, int]) -> Tensor:
        """Categories on the working grid, a few images at a time so that memory stays bounded."""
        table = self._table.to(labels.device)
        images_at_once = max(1, PIXELS_AT_ONCE // labels[0].numel())
        reduced = []
        for part in labels.split(images_at_once):
            categories = categorise(part, table, self._origin)
            refuse_unknown(labels, categories, self.label_space)
            reduced.append(reduce_by_majority(categories, grid))
        return torch.cat(reduced)

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compiles what gains from it: a sweep of the thinning over the batch, for every size.

        The numbers stay the same. The first call after it takes some seconds. The rest of the
        method follows the data, how many runs and points there are, and stays eager.

        Args:
            args, kwargs: for `torch.compile`.
        """
        sweep = partial(sweep_into, RULES[self.config.thinning])
        fused = torch.compile(sweep, *args, **{"dynamic": True, **kwargs})
        self._thin = partial(thin_by_sweeps, sweep=fused)

    def extra_repr(self) -> str:
        """What ``print(head)`` shows: the preset, the label space and the fingerprint."""
        return ", ".join((self.config.preset, self.config.labels_as, self.config.fingerprint))


@dataclass(frozen=True)
class Explanation:
    """What the method saw, for B images on a working grid of ``h x w`` pixels.

    Attributes:
        layers: ``(B, 8, h, w)`` bool, the categories after the reduction to the grid.
        clean_layers: likewise, after morphology, hole filling and small-region removal.
        skeleton: likewise.
        end_points: likewise.
        intersections: likewise.
        centres: ``(B, 8, 2)`` int64, row and column of each layer's centre (Eq. 1), -1 without.
        descriptor: ``(B, 480)`` float32.
        point_histograms: ``(B, 8, N, M)`` int64, the sum of all d_i of Eq. 2; ``None`` for
            harmonics.
        centre_histograms: ``(B, 8, N, M)`` int64, d_c of Eq. 2; likewise.
        vista: ``(B,)`` int64, columns from the middle to where the view opens; ``None`` for
            residuals.
        vista_histograms: ``(B, 8, N, M)`` float64, what stands in the soft bins around it;
            likewise.
    """

    layers: Tensor
    clean_layers: Tensor
    skeleton: Tensor
    end_points: Tensor
    intersections: Tensor
    centres: Tensor
    descriptor: Tensor
    point_histograms: Tensor | None = None
    centre_histograms: Tensor | None = None
    vista: Tensor | None = None
    vista_histograms: Tensor | None = None

    @property
    def keypoints(self) -> Tensor:
        """``(B, 8, h, w)`` bool, end points and intersections."""
        return self.end_points | self.intersections

    @property
    def empty(self) -> Tensor:
        """``(B,)`` bool, images whose descriptor is zero: they match nothing."""
        return ~self.descriptor.any(dim=1)


def _twin(config: SSRVLADConfig) -> nn.Module:
    from .soft.descriptor import SoftSSRVLAD  # which has a head of its own

    return SoftSSRVLAD(config)


def _zeros_of(soft: Tensor) -> Tensor:
    """float32 zeros with the gradient of a tensor."""
    return (soft - soft.detach()).float()


def _tables(config: SSRVLADConfig) -> tuple[Tensor, Tensor]:
    """Soft bins and patterns. They are no buffers: ``head.half()`` must not round them."""
    bins = bin_table(CELLS, config.rings, config.sectors, config.radius, config.inner_radius)
    patterns = pattern_table(config.rings, config.sectors, config.harmonics, config.sharpening)
    return bins, patterns


def _label_map(labels: Tensor, space: LabelSpace) -> Tensor:
    """Checks the input and takes the class of the highest score where it is class scores."""
    got = f"got {tuple(labels.shape)} {str(labels.dtype).removeprefix('torch.')}"
    if labels.ndim == 3 and (labels.is_floating_point() or labels.dtype == torch.bool):
        raise ValueError(f"a (B, H, W) label map must hold integer ids, {got}")
    if labels.ndim == 4 and not labels.is_floating_point():
        raise ValueError(f"(B, C, H, W) class scores must be floating point, {got}")
    if labels.ndim not in (3, 4) or labels.is_complex():
        raise ValueError(f"wanted (B, H, W) label ids or (B, C, H, W) class scores, {got}")
    if labels.numel() == 0:
        raise ValueError(f"wanted at least one image of at least one pixel, {got}")
    return _best_class(labels, space) if labels.ndim == 4 else labels


def _best_class(scores: Tensor, space: LabelSpace) -> Tensor:
    wanted = space.channel_counts
    if scores.shape[1] not in wanted:
        counts = " or ".join(str(count) for count in wanted) or "no class scores, its ids have gaps"
        raise ValueError(
            f"class scores have {scores.shape[1]} classes; label space {space.name} wants {counts}"
        )
    if bool(scores.isnan().any()):
        raise ValueError(f"class scores hold {int(scores.isnan().sum())} NaN values; wanted none")
    return scores.argmax(1)
