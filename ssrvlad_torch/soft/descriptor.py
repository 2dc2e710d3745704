"""The differentiable twin: class scores -> descriptors, with a gradient for every score."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from ..bitplanes import unpack
from ..config import SSRVLADConfig
from ..front_end import FrontEnd
from ..stages.boundaries import WIDTH
from ..stages.grid_pooling import CELLS, ROWS
from ..stages.harmonics import harmonic_tables
from ..stages.layers import best_class
from ..stages.residuals import masks_of
from ..taxonomy import NO_LAYER
from .stages.boundaries import soft_boundaries
from .stages.centroid import soft_centroids, soft_points
from .stages.grid_pooling import soft_pool
from .stages.harmonics import soft_coefficients
from .stages.keypoints import soft_keypoints
from .stages.layers import are_probabilities, membership, soft_layers, soft_merge
from .stages.morphology import soft_open_and_close
from .stages.reduction import soft_majority
from .stages.regions import soft_regions
from .stages.residuals import soft_aggregate
from .stages.shape_context import bin_masks, soft_shape_contexts
from .stages.skeleton import soft_skeleton
from .stages.vanishing_column import soft_vanishing_columns

HARD_FRACTION = 0.95
"""At temperature 1: the fraction of the thinned skeleton in the soft one, and the fraction of a bin
that counts in that bin only."""


class SoftSSRVLAD(nn.Module):
    """Class scores -> place descriptors through which a segmentation network can be trained.

    Each step is that of `SSRVLAD` in real numbers. Yes-or-no decisions are those of `SSRVLAD`,
    without a gradient: which holes are filled, which regions are dropped, which pixels the thinning
    keeps. The module has no weights.

    Args:
        config: the settings, of either aggregation; the default is the preset ``default``.
        temperature: it divides the logits, and ``softness`` follows it. At 1 probabilities stay as
            they are and the descriptor is near the hard one. Towards 0 it becomes the hard one and
            gradients vanish; above 1 everything is softer.

    Shape:
        - input: ``(B, C, H, W)`` floating class scores: logits, or probabilities, which are
          recognised by their sums (see `are_probabilities`); any ``H`` and ``W`` from 1.
        - output: ``(B, 480)`` float32, float64 for float64 input, of length 1; shorter if the image
          shows almost no category, exact zeros if it shows none. Autocast does not change it.

    Raises:
        ValueError: the temperature is not above 0; `SSRVLAD` refuses the input; the input is a
            label map, or the largest score of a pixel is infinite.

    Example:
        >>> scores = torch.randn(2, 19, 60, 80, requires_grad=True)
        >>> SoftSSRVLAD()(scores)[0].sum().backward()
    """

    def __init__(self, config: SSRVLADConfig | None = None, temperature: float = 1.0) -> None:
        super().__init__()
        if not 0 < temperature < float("inf"):
            raise ValueError(f"temperature must be a number above 0, got {temperature!r}")
        self.config = config or SSRVLADConfig()
        self.temperature = temperature
        self._front_end = FrontEnd(self.config)
        self._tables = harmonic_tables(self.config)

    @property
    def softness(self) -> float:
        """Fraction of the eroded skeleton, and of a bin that also counts in the next; 0 to 1."""
        return float(1 - HARD_FRACTION**self.temperature)

    def forward(self, scores: Tensor, layers: Tensor | None = None) -> Tensor:
        """The descriptors of a batch; ``layers`` are the hard layers, if they are known."""
        if scores.ndim != 4:
            raise ValueError(f"expected (B, C, H, W) class scores, got {tuple(scores.shape)}")
        with torch.autocast(scores.device.type, enabled=False):
            wide = scores.float() if scores.dtype in (torch.half, torch.bfloat16) else scores
            _refuse_infinite(wide)
            if layers is None:
                layers = self._hard_layers(wide.detach())
            return self._describe(wide, layers)

    def _hard_layers(self, scores: Tensor) -> Tensor:
        """The hard layers. A pixel is in no layer if 1 minus the sum of its probabilities is larger
        than each of them."""
        layers = cast(Tensor, self._front_end(scores))
        classes = self._front_end.label_space.classes
        no_layer = [label.id for label in classes if label.category_index == NO_LAYER]
        if not (no_layer and are_probabilities(scores)):
            return layers
        void = 1 - scores.sum(1) > scores.amax(1)
        if not bool(void.any()):
            return layers
        void_or_best = best_class(scores).masked_fill(void, no_layer[0])
        return cast(Tensor, self._front_end(void_or_best))

    def _describe(self, scores: Tensor, hard: Tensor) -> Tensor:
        members = membership(self._front_end.label_space, scores.shape[1])
        layers = soft_layers(scores, members, self.temperature)  # Table II
        layers = soft_majority(layers, self.config.grid(*scores.shape[2:]), self.temperature)
        if self.config.aggregation == "harmonics":
            return self._harmonics(layers)
        return self._residuals(layers, hard)

    def _residuals(self, layers: Tensor, hard: Tensor) -> Tensor:
        """Eq. 2 in one correlation: each keypoint weighs 1, the centre minus their number."""
        config, grid = self.config, (layers.shape[2], layers.shape[3])
        radii = [config.radius_pixels(part, *grid) for part in (config.opening, config.closing)]
        masks = masks_of(hard, config)
        clean = soft_open_and_close(layers, *radii)
        clean = soft_regions(clean, unpack(masks.closed), unpack(masks.clean))
        skeleton = soft_skeleton(clean, unpack(masks.skeleton), self.softness)
        keypoints = soft_keypoints(skeleton)
        centres = soft_points(soft_centroids(clean), *grid)  # Eq. 1
        context = skeleton if config.context == "skeleton" else keypoints

        bins = bin_masks(
            *grid,
            config.ring_limits(*grid),
            config.sectors,
            self.softness,
            clean.dtype,
            clean.device,
        )
        references = keypoints - keypoints.sum((2, 3), keepdim=True) * centres
        return soft_aggregate(soft_shape_contexts(references, context, bins))  # Eq. 2

    def _harmonics(self, layers: Tensor) -> Tensor:
        """The coefficients of the soft histograms around the anchor."""
        config, layers = self.config, soft_merge(layers)
        column = layers.new_zeros(len(layers))
        if config.anchor == "vanishing-column":
            column = soft_vanishing_columns(layers)
        bins, basis = (table.to(layers) for table in self._tables)
        unit = min(layers.shape[2:]) / ROWS / WIDTH
        return soft_coefficients(
            soft_pool(layers, column, CELLS),
            soft_pool(soft_boundaries(layers), column, CELLS) * unit,
            bins,
            basis,
            (config.harmonics, config.boundary_harmonics),
            config.power,
        )

    def extra_repr(self) -> str:
        """What ``print(twin)`` shows: the temperature."""
        return f"temperature={self.temperature:g}"


def _refuse_infinite(scores: Tensor) -> None:
    """Raises an error for pixels whose largest score is infinite: they have no softmax."""
    largest = scores.detach().amax(1)
    if not bool(largest.isinf().any()):
        return
    raise ValueError(
        f"class scores of {int(largest.isinf().sum())} pixels are infinite; expected finite ones "
        "to train through (half precision holds 65504 at most)"
    )
