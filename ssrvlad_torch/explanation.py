"""What the method saw on the way to its descriptors."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from .stages.harmonics import HarmonicHistograms
from .stages.residuals import ResidualHistograms
from .taxonomy import LabelSpace

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Explanation:
    """What the method saw, for B images on a working grid of ``h x w`` pixels.

    A notebook shows it as the picture of `show`.

    Attributes:
        labels: ``(B, H, W)`` ids, the label maps; of class scores, the best class.
        label_space: what the ids mean.
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

    labels: Tensor
    label_space: LabelSpace
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

    def show(self, image: int = 0, title: str = "") -> Figure:
        """One image of the batch as a matplotlib figure.

        Above stands the label map with its classes. Below, for the residuals of ``paper``, the
        clean layers with skeleton, keypoints and centre, each above its histogram; for the
        harmonics of ``default`` the layers and the boundaries, with the vanishing column, each
        above its histogram.

        Args:
            image: its number in the batch.
            title: stands above the label map.

        Raises:
            ImportError: matplotlib is not installed (extra ``eval``).
            IndexError: there is no such image.
        """
        from .picture import draw

        if not 0 <= image < len(self.labels):
            raise IndexError(f"expected an image from 0 to {len(self.labels) - 1}, got {image}")
        return draw(self, image, title)

    def __repr__(self) -> str:
        images, (height, width) = len(self.labels), self.layers.shape[2:]
        grid = f"{width} x {height}"
        return f"Explanation({images} image{'s'[: images > 1]} of {self.label_space.name}, {grid})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the picture of the first image."""
        try:
            figure = self.show()
        except ImportError as error:
            return f"{self!r}. {error}"
        content = io.BytesIO()
        figure.savefig(content, dpi=80, format="png")
        picture = base64.b64encode(content.getvalue()).decode()
        others = len(self.labels) - 1
        more = f"<p>{others} more: <code>.show(image=1)</code></p>" if others else ""
        return f'<img alt="{self!r}" src="data:image/png;base64,{picture}">{more}'
