"""Residuals: how the keypoints' histograms differ from the one around the centre (Eq. 2).

It is one of the two aggregations: layers -> clean layers -> skeletons -> keypoints -> histograms ->
descriptor. `harmonics` is the other."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import SSRVLADConfig
from .bitplanes import by_image, count_groups, points
from .centroid import centroids
from .components import drop_regions, fill_holes
from .keypoints import end_points, intersections
from .layers import split
from .lengths import lengths
from .morphology import open_and_close
from .shape_context import log_polar_bins, shape_contexts
from .skeleton import RULES, thin
from .tracing import real


class ResidualHistograms(NamedTuple):
    """The histograms of Eq. 2, int64.

    Attributes:
        points: ``(B, 8, N, M)``, the sum of all d_i of each layer.
        centre: ``(B, 8, N, M)``, d_c of each layer.
        counts: ``(B, 8)``, the number of keypoints of each layer.
    """

    points: Tensor
    centre: Tensor
    counts: Tensor


class Residuals:
    """The paper's aggregation."""

    def __init__(self, config: SSRVLADConfig) -> None:
        self.config = config

    def histograms(self, layers: Tensor) -> ResidualHistograms:
        """Shape contexts around the keypoints and the centre of each layer, of ``(B, h, w)`` uint8,
        the layer of each pixel, 0 to 7 or `NO_LAYER`."""
        config, (images, height, width) = self.config, layers.shape
        _, clean, skeleton = masks_of(layers, config)
        keypoints = points(end_points(skeleton) | intersections(skeleton))
        centres = centroids(clean)  # Eq. 1
        context = points(skeleton) if config.context == "skeleton" else keypoints

        limits = lengths(config, height, width).ring_limits
        bins = log_polar_bins(height, width, limits, config.sectors, layers.device)
        shape = (images, -1, config.rings, config.sectors)
        around_points, around_centre = (
            shape_contexts(references, context, bins, images).reshape(shape)
            for references in (keypoints, centres)
        )
        counts = by_image(count_groups(keypoints, images), images)
        return ResidualHistograms(around_points, around_centre, counts)

    def descriptor(self, histograms: ResidualHistograms) -> Tensor:
        """``(B, 8 * N * M)`` float32: the layers' vectors, each of length 1 or exactly zero,
        concatenated and normalised; exact zeros for an image in which every layer is zero."""
        points, centre, counts = histograms
        residuals = points.flatten(2) - counts[..., None] * centre.flatten(2)  # Eq. 2, numerator
        layers = F.normalize(residuals.to(real()), dim=-1)  # Eq. 2; zeros stay zeros
        descriptor = F.normalize(layers.flatten(1), dim=-1).float()
        too_many = (points < 0).flatten(1).any(1, keepdim=True)  # only under export
        return torch.where(too_many, torch.nan, descriptor)


def masks_of(layers: Tensor, config: SSRVLADConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The paper's bit-planes of the layers ``(B, h, w)`` uint8 of pixels: as they are; clean, which
    is opened and closed, small holes filled, small regions dropped; and the skeletons of these."""
    planes = split(layers)
    sizes = lengths(config, layers.shape[1], layers.shape[2])
    closed = open_and_close(planes, sizes.opening, sizes.closing)
    clean = drop_regions(fill_holes(closed, sizes.hole_area), sizes.region_area)
    return planes, clean, thin(clean, RULES[config.thinning])
