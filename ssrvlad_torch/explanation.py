"""What the method saw on the way to its descriptors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from .stages.harmonics import HarmonicHistograms
from .stages.residuals import ResidualHistograms


@dataclass(frozen=True)
class Explanation:
    """What the method saw, for B images on a working grid of ``h x w`` pixels.

    Attributes:
        layers: ``(B, 8, h, w)`` bool, the categories after the reduction to the grid.
        clean_layers: likewise, after morphology, hole filling and small-region removal.
        skeleton: likewise, of the clean layers.
        end_points: likewise, of the skeleton.
        intersections: likewise, of the skeleton.
        centres: ``(B, 8, 2)`` int64, row and column of each layer's centre (Eq. 1), -1 for a layer
            without pixels.
        histograms: what the aggregation counted: `ResidualHistograms` or `HarmonicHistograms`.
        descriptor: ``(B, 480)`` float32.
    """

    layers: Tensor
    clean_layers: Tensor
    skeleton: Tensor
    end_points: Tensor
    intersections: Tensor
    centres: Tensor
    histograms: ResidualHistograms | HarmonicHistograms
    descriptor: Tensor

    @property
    def keypoints(self) -> Tensor:
        """``(B, 8, h, w)`` bool, end points and intersections."""
        return self.end_points | self.intersections

    @property
    def empty(self) -> Tensor:
        """``(B,)`` bool, images whose descriptor is zero: they match nothing."""
        return ~self.descriptor.any(dim=1)
