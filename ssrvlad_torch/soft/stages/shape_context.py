"""Soft shape context: the correlation of two maps, summed under smooth ring and sector masks.

The sum of the histograms around weighted reference points counts every pair of a reference and a
context pixel by its offset. The correlation of the two maps, computed by FFT, gives the weight of
each offset; a mask gives the offsets of each bin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import torch
from torch import Tensor

NEAREST = 0.25
"""A squared distance below that of any two pixels, the smallest with a logarithm here."""


def soft_shape_contexts(references: Tensor, context: Tensor, masks: Tensor) -> Tensor:
    """Weighted sum of the shape contexts around each layer's reference points.

    Args:
        references: ``(B, 8, h, w)`` weights of the reference points, of any sign.
        context: ``(B, 8, h, w)`` weights of the context points.
        masks: `bin_masks` for the size of the image.

    Returns:
        ``(B, 8, N * M)``.
    """
    images, layers, height, width = references.shape
    size = 2 * height, 2 * width
    spectrum = torch.fft.rfft2(references, s=size).conj() * torch.fft.rfft2(context, s=size)
    pairs = torch.fft.irfft2(spectrum, s=size)  # at (dy, dx), both modulo the size
    sums: Tensor = torch.sparse.mm(masks, pairs.view(images * layers, -1).T)
    return sums.T.view(images, layers, -1)


@lru_cache(maxsize=4)
@torch.inference_mode(False)  # cached masks are used in training too
def bin_masks(
    height: int,
    width: int,
    limits: tuple[int, ...],
    sectors: int,
    softness: float,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """The masks of all bins over the offsets.

    A pair just past the end of a ring, or just before the start of a sector, counts in both bins,
    linearly in the logarithm of the distance and in the angle. On a boundary it counts in the bin
    of the hard method.

    Args:
        height, width: size of the image.
        limits: largest squared distance of each ring, innermost first.
        sectors: M; the first starts at +x (right), towards +y (down).
        softness: fraction of a ring or a sector that also counts in the next one, 0 to 1.
        dtype, device: of the masks.

    Returns:
        ``(N * M, 4 * height * width)`` sparse. A column is an offset ``(dy, dx)``, each modulo
        twice the size of the image; the offset (0, 0) is in no bin.
    """
    dy, dx = (_offsets(size, device) for size in (height, width))
    squared = (dy[:, None] ** 2 + dx**2).flatten()
    bins, places, weights = [], [], []
    for ring, within in enumerate(_rings(squared, limits, softness)):
        place = (within * (squared > 0)).nonzero()[:, 0]
        turn = torch.atan2(dy[place // len(dx)], dx[place % len(dx)]) / (2 * math.pi) % 1
        sector, into_next = _sectors(turn * sectors, softness)
        for after, fraction in ((0, 1 - into_next), (1, into_next)):
            bins.append(ring * sectors + (sector + after) % sectors)
            places.append(place)
            weights.append(within[place] * fraction)
    weight = torch.cat(weights)
    positive = weight > 0
    indices = torch.stack([torch.cat(bins), torch.cat(places)])[:, positive]
    shape = len(limits) * sectors, len(squared)
    values = weight[positive].to(dtype)
    return torch.sparse_coo_tensor(indices, values, shape, check_invariants=True).coalesce()


def _offsets(size: int, device: torch.device) -> Tensor:
    """``(2 * size,)`` float64: 0 to size - 1, then -size to -1."""
    return (torch.arange(2 * size, device=device) + size).double() % (2 * size) - size


def _rings(squared: Tensor, limits: tuple[int, ...], softness: float) -> Iterator[Tensor]:
    """How much of each squared distance counts in each ring: the part past the end of the previous
    ring minus the part past its own."""
    logarithm = squared.clamp(min=NEAREST).log()
    ends = [math.log(max(limit, NEAREST)) for limit in limits]
    ramp = softness * ((ends[-1] - ends[0]) / max(1, len(ends) - 1) or math.log(4))
    before = torch.ones_like(squared)
    for limit, end in zip(limits, ends, strict=True):
        fraction = ((logarithm - end) / ramp).clamp(0, 1) if ramp else 1.0
        past = (squared > limit) * fraction
        yield before - past
        before = past


def _sectors(position: Tensor, softness: float) -> tuple[Tensor, Tensor]:
    """The sector at each position from 0 to M, and how much of it counts in the next sector."""
    sector = torch.floor(position + 1e-9)
    left = 1 - (position - sector).clamp(min=0)
    into_next = (1 - left / softness).clamp(min=0) if softness else torch.zeros_like(left)
    return sector.long(), into_next
