"""Soft shape context: the correlation of two maps, summed under smooth ring and sector masks.

The sum of the histograms around weighted reference points counts every pair of a reference and a
context pixel by its offset. How often each offset occurs is the correlation of the two maps, by
FFT; which offsets make a bin is a mask.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

NEAREST = 0.25
"""A squared distance below that of any two pixels, where logarithms begin."""


def soft_shape_contexts(references: Tensor, context: Tensor, masks: Tensor) -> Tensor:
    """Sum of the shape contexts around each layer's reference points, weight by weight.

    Args:
        references: ``(B, 8, h, w)`` weights of the points around which is counted, of any sign.
        context: ``(B, 8, h, w)`` weights of the points that are counted.
        masks: `bin_masks` for the size of the image.

    Returns:
        ``(B, 8, N * M)``.
    """
    size = masks.shape[1:]
    spectrum = torch.fft.rfft2(references, s=size).conj() * torch.fft.rfft2(context, s=size)
    pairs: Tensor = torch.fft.irfft2(spectrum, s=size)  # at (dy, dx), both modulo the size
    return pairs.flatten(2) @ masks.flatten(1).T


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

    Past the end of a ring, and before the start of a sector, a pair counts in both bins, linearly
    in the logarithm of the distance and in the angle. On a boundary it counts where the hard
    method has it.

    Args:
        height, width: size of the image.
        limits: largest squared distance of each ring, innermost first.
        sectors: M; the first starts at +x (right), towards +y (down).
        softness: width of what is shared as a fraction of a ring or a sector, 0 to 1.
        dtype, device: of the masks.

    Returns:
        ``(N * M, 2 * height, 2 * width)``, the offset ``(dy, dx)`` modulo the size; the offset
        (0, 0) is in no bin.
    """
    place, weight = _entries(height, width, limits, sectors, softness, device)
    masks = torch.zeros(len(limits) * sectors * 4 * height * width, dtype=dtype, device=device)
    masks[place] = weight.to(dtype)
    return masks.view(-1, 2 * height, 2 * width)


@lru_cache(maxsize=4)
@torch.inference_mode(False)  # what is kept is used in training, too
def _entries(
    height: int,
    width: int,
    limits: tuple[int, ...],
    sectors: int,
    softness: float,
    device: torch.device,
) -> tuple[Tensor, Tensor]:
    """Where the masks are not zero, and what they are there: most offsets are in one bin only."""
    dy, dx = (_offsets(size, device) for size in (height, width))
    squared = dy[:, None] ** 2 + dx**2
    turn = torch.atan2(dy[:, None], dx[None]) / (2 * math.pi) % 1
    ring = _rings(squared, limits, softness) * (squared > 0)
    masks = ring[:, None] * _sectors(turn * sectors, sectors, softness)
    place = masks.flatten().nonzero()[:, 0]
    return place, masks.flatten()[place]


def _offsets(size: int, device: torch.device) -> Tensor:
    """``(2 * size,)`` float64: 0 to size - 1, then -size to -1."""
    return (torch.arange(2 * size, device=device) + size).double() % (2 * size) - size


def _rings(squared: Tensor, limits: tuple[int, ...], softness: float) -> Tensor:
    """``(N, ...)`` shares of the rings: what lies past the ring before, and not past its own."""
    logarithm = squared.clamp(min=NEAREST).log()
    ends = [math.log(max(limit, NEAREST)) for limit in limits]
    ramp = softness * ((ends[-1] - ends[0]) / max(1, len(ends) - 1) or math.log(4))
    past = [torch.ones_like(squared)]
    for limit, end in zip(limits, ends, strict=True):
        share = ((logarithm - end) / ramp).clamp(0, 1) if ramp else 1.0
        past.append((squared > limit) * share)
    return torch.stack([before - own for before, own in pairwise(past)])


def _sectors(position: Tensor, count: int, softness: float) -> Tensor:
    """``(M, ...)`` shares of the sectors at positions from 0 to M."""
    whole = torch.floor(position + 1e-9)
    into = (1 - (1 - (position - whole).clamp(min=0)) / softness).clamp(min=0) if softness else 0
    here = whole % count == torch.arange(count, device=position.device)[:, None, None]
    return here * (1 - into) + here.roll(1, 0) * into
