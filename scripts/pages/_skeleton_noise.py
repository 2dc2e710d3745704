"""Skeleton noise: descriptors of images whose skeleton points were shifted at random (Table IV).

Where a network draws the boundary of a region a little differently, the skeleton lies elsewhere.
The paper imitates this by shifting "the extracted skeleton nodes" at random, each in both
coordinates, and asks how often the original image is still the best match. It does not say whether
the nodes are all pixels of the skeleton or its end points and intersections: here either can be
shifted. The harmonics of ``default`` do not look at a skeleton.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ssrvlad_torch.config import SSRVLADConfig
from ssrvlad_torch.descriptor import SSRVLAD
from ssrvlad_torch.stages.bitplanes import Points, count_points, pack, points
from ssrvlad_torch.stages.centroid import centroids
from ssrvlad_torch.stages.residuals import aggregate
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts


@dataclass(frozen=True)
class SkeletonPoints:
    """The skeletons of some images as points that can be shifted, and the rest of the description.

    The centre of each layer (Eq. 1) stays. Points may leave the image or fall onto one another: the
    shape context counts each wherever it is.

    Attributes:
        config: the settings.
        images: B.
        size: rows and columns of the label maps.
        skeleton: the skeleton pixels.
        nodes: the keypoints among them.
        node_rows: ``(n,)`` int64, which skeleton pixel each keypoint is.
        centres: of the layers.
        margin: pixels of the grid by which points may lie outside it.

    Example:
        >>> head = SSRVLAD.from_preset("paper")
        >>> labels = torch.arange(19).repeat(4, 40, 5)
        >>> original = SkeletonPoints.of(head, labels)
        >>> noisy = original.shifted(3, torch.Generator().manual_seed(0))
        >>> noisy.descriptors().shape
        torch.Size([4, 480])
    """

    config: SSRVLADConfig
    images: int
    size: tuple[int, int]
    skeleton: Points
    nodes: Points
    node_rows: Tensor
    centres: Points
    margin: int = 0

    @classmethod
    def of(cls, head: SSRVLAD, labels: Tensor) -> SkeletonPoints:
        """The points of a batch; input and errors as for a call of the head."""
        view = head.explain(labels)
        skeleton = points(pack(view.skeleton))
        is_node = view.keypoints.transpose(0, 1).flatten(0, 1)[skeleton]
        node_rows = is_node.nonzero()[:, 0]
        return cls(
            config=head.config,
            images=len(view.skeleton),
            size=(int(labels.shape[-2]), int(labels.shape[-1])),
            skeleton=skeleton,
            nodes=Points(*(part[node_rows] for part in skeleton)),
            node_rows=node_rows,
            centres=centroids(pack(view.clean_layers)),
        )

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the working grid."""
        return self.config.grid(*self.size)

    def shifted(
        self, pixels: int, generator: torch.Generator, nodes_only: bool = False
    ) -> SkeletonPoints:
        """A copy with every point shifted by a random integer of -pixels to +pixels in both axes.

        All shifts are equally likely. They are in pixels of the label map, and on a smaller
        working grid become as many of its pixels as fit, rounded.

        Args:
            pixels: 0 or more.
            generator: of the shifts.
            nodes_only: the keypoints are shifted and the skeleton that they see is not. Else
                every skeleton pixel is, and a keypoint goes with its own.

        Raises:
            ValueError: ``pixels`` is negative.
        """
        if pixels < 0:
            raise ValueError(f"expected a shift of 0 pixels or more, got {pixels}")
        drawn = torch.randint(
            -pixels, pixels + 1, (2, len(self.skeleton.group)), generator=generator
        )
        scale = min(self.grid) / min(self.size)
        shift = (drawn * scale).round().long()
        return dataclasses.replace(
            self,
            skeleton=self.skeleton if nodes_only else _moved(self.skeleton, shift),
            nodes=_moved(self.nodes, shift[:, self.node_rows]),
            margin=self.margin + math.ceil(pixels * scale),
        )

    def descriptors(self) -> Tensor:
        """``(B, 480)`` float32 descriptors; without shifts, those of the head."""
        config, (height, width) = self.config, self.grid
        limits, reach = config.ring_limits(height, width), 2 * self.margin
        device = self.skeleton.group.device
        bins = log_polar_bins(height + reach, width + reach, limits, config.sectors, device)
        context = self.skeleton if config.context == "skeleton" else self.nodes
        around_nodes = shape_contexts(self.nodes, context, bins, self.images)
        around_centres = shape_contexts(self.centres, context, bins, self.images)
        return aggregate(around_nodes, around_centres, count_points(self.nodes, self.images))


def _moved(listed: Points, shift: Tensor) -> Points:
    return Points(listed.group, listed.y + shift[0], listed.x + shift[1])
