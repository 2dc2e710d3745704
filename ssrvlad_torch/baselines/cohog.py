"""CoHOG (Zaffar, Ehsan, Milford, McDonald-Maier, RA-L 2020): regions of high entropy by HOG.

Where the paper is silent, this follows the authors' public code in VPR-Bench: 512 x 512 pixels,
cells of 16 with 8 signed directions, regions of 2 x 2 cells at every cell, entropy threshold 0.4 of
8 bits, entropy in discs of radius 5 on 100 x 100 pixels, a gradient measured by ``|gx + gy| / 2``.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import View, batches
from ..channels.hog import CELL, cell_histograms, grays, resize

ORIENTATIONS = 8

SIDE, THRESHOLD = 512, 0.4
"""Sides of a picture in pixels, and the least mean entropy of a chosen region, a fraction of 8
bits."""

REGIONS = (SIDE // CELL - 1) ** 2

ENTROPY_SIDE = 100
ENTROPY_RADIUS = 5

_OUTSIDE = 256
_BATCH = 4
_SCORES_AT_ONCE = 1 << 20


class Regions(NamedTuple):
    """Encoded queries: descriptors ``(Q, regions, 32)`` float32 of length 1, or 0, and which
    regions have enough entropy, ``(Q, regions)`` bool."""

    descriptors: Tensor
    chosen: Tensor


class CoHOG:
    """The mean, over the query's regions of high entropy, of the largest cosine with a region of
    the reference. A query without such a region matches nothing."""

    name = "cohog"
    needs = frozenset({"images"})

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Regions:
        """The regions of every query, and which of them are compared."""
        described, chosen = list[Tensor](), list[Tensor]()
        for pictures in map(self._pictures, batches(frames, _BATCH)):
            described.append(region_descriptors(pictures))
            chosen.append(region_entropies(pictures) >= THRESHOLD)
        return Regions(torch.cat(described), torch.cat(chosen))

    @torch.no_grad()
    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, regions, 32)`` float32, the descriptors of all regions."""
        pictures = map(self._pictures, batches(frames, _BATCH))
        return torch.cat([*map(region_descriptors, pictures)])

    @torch.no_grad()
    def scores(self, queries: Regions, references: Tensor) -> Tensor:
        """Regional convolutional matching, ``(Q, R)``."""
        scores = torch.full((len(queries.chosen), len(references)), -torch.inf)
        for row, descriptors, chosen in zip(scores, *queries, strict=True):
            regions = descriptors[chosen]
            if len(regions) == 0:
                continue
            at_once = max(1, _SCORES_AT_ONCE // (len(regions) * REGIONS))
            for places, block in zip(row.split(at_once), references.split(at_once), strict=True):
                cosines = regions @ block.flatten(0, 1).T
                places.copy_(cosines.unflatten(1, (len(block), -1)).amax(2).mean(0))
        return scores

    def _pictures(self, frames: Sequence[View]) -> Tensor:
        return resize(grays(frames, self.name), SIDE, SIDE)


def region_descriptors(pictures: Tensor) -> Tensor:
    """HOG of 2 x 2 cells at every cell, by the root of gray and 5 x 5 Sobel, votes for the two
    nearest directions: ``(B, regions, 32)`` float32 of pictures ``(B, H, W)`` uint8, of length 1,
    or 0."""
    brightest = pictures.amax((1, 2), keepdim=True).clamp(min=1)
    rooted = (pictures / brightest).sqrt()
    mirrored = F.pad(rooted[:, None], (2, 2, 2, 2), mode="reflect")[:, 0]  # as OpenCV does
    along_x, along_y = _smooth(_derive(mirrored).mT).mT, _smooth(_derive(mirrored.mT).mT)
    turn = torch.atan2(along_y, along_x) / (2 * torch.pi) % 1 * ORIENTATIONS
    lower, strength = turn.long(), (along_x + along_y).abs()
    fraction = turn - lower
    cells = cell_histograms(lower % ORIENTATIONS, strength * (1 - fraction), ORIENTATIONS)
    cells += cell_histograms((lower + 1) % ORIENTATIONS, strength * fraction, ORIENTATIONS)
    blocks = (cells[:, :-1, :-1], cells[:, :-1, 1:], cells[:, 1:, :-1], cells[:, 1:, 1:])
    return F.normalize(torch.cat(blocks, -1).flatten(1, 2), dim=-1)


def _derive(rows: Tensor) -> Tensor:
    """The first factor of Sobel's filter; its differences are exact zeros in flat areas."""
    return rows[..., 4:] - rows[..., :-4] + 2 * (rows[..., 3:-1] - rows[..., 1:-3])


def _smooth(rows: Tensor) -> Tensor:
    """The second factor."""
    next_ones = rows[..., 3:-1] + rows[..., 1:-3]
    return rows[..., 4:] + rows[..., :-4] + 4 * next_ones + 6 * rows[..., 2:-2]


def region_entropies(pictures: Tensor) -> Tensor:
    """Mean entropy of the gray values around the pixels of each region, as a fraction of 8 bits:
    ``(B, regions)`` float32 of pictures and regions as in `region_descriptors`."""
    bits = local_entropy(resize(pictures, ENTROPY_SIDE, ENTROPY_SIDE), ENTROPY_RADIUS)
    bits = F.interpolate(bits[:, None], pictures.shape[1:], mode="bilinear")
    return F.avg_pool2d(bits, 2 * CELL, CELL).flatten(1) / 8


def local_entropy(pictures: Tensor, radius: int) -> Tensor:
    """Entropy, in bits, of the gray values at most ``radius`` away from each pixel of ``(B, H, W)``
    uint8, as ``skimage.filters.rank.entropy``."""
    images, height, width = pictures.shape
    reach = torch.arange(-radius, radius + 1)
    disc = (reach[:, None] ** 2 + reach**2 <= radius**2).flatten()
    padded = F.pad(pictures.float(), (radius,) * 4, value=_OUTSIDE)
    values = F.unfold(padded[:, None], 2 * radius + 1)[:, disc].mT.long()
    votes = torch.zeros(images, height * width, _OUTSIDE + 1, device=pictures.device)
    votes.scatter_add_(2, values, torch.ones_like(values, dtype=votes.dtype))
    inside = values < _OUTSIDE
    total = inside.sum(2, keepdim=True)
    surprise = (total / votes.gather(2, values)).log2().masked_fill(~inside, 0)
    return (surprise.sum(2) / total[..., 0]).view(images, height, width)
