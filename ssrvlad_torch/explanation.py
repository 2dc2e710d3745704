"""The intermediate results of the method."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from torch import Tensor

from .stages.harmonics import HarmonicHistograms
from .stages.residuals import ResidualHistograms
from .taxonomy import LabelSpace

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Explanation:
    """Every step from label maps to descriptors, for B images on a grid of ``h x w`` pixels.

    A notebook shows it as the picture of `show`. Masks are ``(B, 8, h, w)`` bool.

    Attributes:
        labels: ``(B, H, W)`` ids, the label maps; for class scores, the best class.
        label_space: what the ids mean.
        layers: masks of the categories after the reduction to the grid.
        clean_layers: masks after morphology, hole filling and small-region removal.
        skeleton: masks of the clean layers' skeletons.
        end_points: masks of the end points of the skeleton.
        intersections: masks of the intersections of the skeleton.
        centres: ``(B, 8, 2)`` int64, row and column of each layer's centre (Eq. 1), -1 for a layer
            without pixels.
        histograms: of the aggregation: `ResidualHistograms` or `HarmonicHistograms`.
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
        """``(B,)`` bool, true where the descriptor is zero: such an image matches nothing."""
        return ~self.descriptor.any(dim=1)

    def show(
        self, image: int = 0, title: str = "", picture: npt.NDArray[np.uint8] | None = None
    ) -> Figure:
        """One image of the batch as a matplotlib figure.

        At the top is the label map with its classes. Below are, each above its histogram, the clean
        layers with skeleton, keypoints and centre for the residuals of ``paper``, or the layers and
        boundaries with the vanishing column for the harmonics of ``default``.

        Args:
            image: its number in the batch.
            title: of the label map.
            picture: ``(H, W, 3)`` uint8 of which it is the label map, to be drawn beside it.

        Raises:
            ImportError: matplotlib is not installed (extra ``eval``).
            IndexError: the batch has no such image.
        """
        from .picture import draw

        if not 0 <= image < len(self.labels):
            raise IndexError(f"expected an image from 0 to {len(self.labels) - 1}, got {image}")
        return draw(self, image, title, picture)

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
