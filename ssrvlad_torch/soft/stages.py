"""The stages of the differentiable twin: each is the stage of the same name in real numbers with
gradients, and gives the same result for zeros and ones."""

import math
from functools import reduce
from operator import add, mul

import torch
import torch.nn.functional as F
from torch import Tensor

from ..stages.vanishing_column import OPEN_LAYERS, POWER, PULL
from ..taxonomy import CATEGORIES, LabelSpace

TINY = 1e-6
"""Added to a probability or a fraction before its logarithm, so that 0 has a finite one."""

TOLERANCE = 0.01
"""How far probabilities may be below 0, and their sum away from 1: bfloat16 has three digits."""

PATTERNS = (
    ("1010", "0101"),
    ("1100", "0011"),
    ("1000", "0001", "0111", "1110"),
    ("0100", "0010", "1011", "1101"),
)
"""Of each direction of a boundary: which of the corners NW, NE, SW, SE lie in the layer."""

FAINT = 1e-3
"""Fraction of a bin below which a root is nearly a straight line."""

LEAST = 0.1
"""The length that a descriptor needs before normalisation: a much shorter one, of an image that
shows almost no category, keeps a length below 1."""


def membership(space: LabelSpace, channels: int) -> Tensor:
    """``(C, 8)`` float64, 1 where the class of a channel has the category; rows of dynamic and void
    classes are zero. Channel ``c`` stands for id ``c``."""
    categories = {label.id: label.category_index for label in space.classes}
    columns = torch.tensor([categories[channel] for channel in range(channels)])
    return torch.eye(len(CATEGORIES) + 1).double()[columns, : len(CATEGORIES)]


def soft_layers(scores: Tensor, members: Tensor, temperature: float) -> Tensor:
    """The probability of every category at every pixel, ``(B, 8, H, W)``, the sum over its classes
    by `membership`; the rest to 1 belongs to no layer. Scores ``(B, C, H, W)`` are logits, which
    the temperature divides, or probabilities, which count by their logarithm (see
    `are_probabilities`); if these sum to less than 1, the rest is void."""
    if are_probabilities(scores):
        missing = 1 - scores.sum(1, keepdim=True)
        missing = missing.where(missing > TOLERANCE, 0)
        scores = (torch.cat([scores.clamp(min=0), missing], 1) + TINY).log()
    classes = (scores / temperature).softmax(1)[:, : len(members)]
    return torch.einsum("bchw,ck->bkhw", classes, members.to(classes))


def soft_merge(layers: Tensor) -> Tensor:
    """``(B, 8, h, w)`` layers -> ``(B, 6, h, w)``, see `merge`."""
    ground, sidewalk, building, pole, vegetation, sky, rail, parking = layers.unbind(1)
    return torch.stack((ground + parking, sidewalk, building + rail, pole, vegetation, sky), 1)


def are_probabilities(scores: Tensor) -> bool:
    """Whether ``(B, C, H, W)`` scores are probabilities: none is below 0, and they sum to 1 or, at
    pixels without a class, to less. One-hot labels are probabilities too."""
    with torch.no_grad():
        totals = scores.sum(1)
        whole = (totals.amax() - 1).abs() <= TOLERANCE
        return bool(whole & (scores.amin() >= -TOLERANCE))


def soft_majority(layers: Tensor, grid: tuple[int, int], temperature: float) -> Tensor:
    """``(B, 8, h, w)``, the fraction of each cell of the grid that each category covers, of layers
    ``(B, 8, H, W)``: fractions to the power of ``1 / temperature``, normalised, in place of the
    vote."""
    if tuple(layers.shape[2:]) == grid:
        return layers
    rows, columns = (
        _means(pixels, cells, layers) for pixels, cells in zip(layers.shape[2:], grid, strict=True)
    )
    fractions = rows @ layers @ columns.T
    no_layer = (1 - fractions.sum(1, keepdim=True)).clamp(min=0)
    votes = (torch.cat([fractions, no_layer], 1).clamp(min=0) + TINY).log() / temperature
    return votes.softmax(1)[:, :-1]


def _means(pixels: int, cells: int, like: Tensor) -> Tensor:
    """``(cells, pixels)`` matrix that takes the mean over the pixels of each cell of a line."""
    cell = torch.arange(pixels, device=like.device) * cells // pixels
    belongs = (cell == torch.arange(cells, device=like.device)[:, None]).to(like)
    return belongs / belongs.sum(1, keepdim=True)


def soft_vanishing_columns(layers: Tensor) -> Tensor:
    """``(B,)``, how many columns right of the middle the vanishing column of ``(B, K, h, w)`` is,
    see `stages.vanishing_column`."""
    width = layers.shape[3]
    open_fraction = layers[:, OPEN_LAYERS].sum(1).clamp(max=1).mean(1)
    weight = open_fraction**POWER
    from_middle = torch.arange(width).to(layers) - (width - 1) / 2
    return (weight @ from_middle) / (weight.sum(1) + width / PULL)


def soft_pool(layers: Tensor, shift: Tensor, cells: tuple[int, int]) -> Tensor:
    """``(B, 8, rows, columns)``, the fraction of every cell that each of layers ``(B, 8, h, w)``
    covers, the image moved ``shift`` ``(B,)`` columns, any real number, to the left."""
    rows = soft_overlaps(layers.shape[2], cells[0], shift.new_zeros(1))
    columns = soft_overlaps(layers.shape[3], cells[1], shift)
    return rows.mT[:, None] @ layers @ columns[:, None]


def soft_overlaps(pixels: int, cells: int, shift: Tensor) -> Tensor:
    """``(B, pixels, cells)``, how much of each cell of a line each pixel covers."""
    pixel = ((torch.arange(pixels).to(shift) - shift[:, None]) * (cells / pixels))[..., None]
    cell = torch.arange(cells).to(shift)
    within = torch.minimum(pixel + cells / pixels, cell + 1) - torch.maximum(pixel, cell)
    return within.clamp(min=0)


def soft_boundaries(layers: Tensor) -> Tensor:
    """``(B, 4, h, w)``, 0 to 1, the weight of each direction, upright, level, rising, falling, at
    every pixel of layers ``(B, K, h, w)``, 0 to 1, as if neighbours were independent."""
    if min(layers.shape[2:]) < 3:
        return torch.zeros_like(layers[:, :4])
    ends = slice(None, -2), slice(2, None)
    corners = [layers[..., y, x] for y in ends for x in ends]

    def weight(pattern: str) -> Tensor:
        pairs = zip(pattern, corners, strict=True)
        return reduce(mul, (corner if inside == "1" else 1 - corner for inside, corner in pairs))

    by_layer = [reduce(add, map(weight, patterns)) for patterns in PATTERNS]
    of_any = [1 - (1 - direction).prod(1) for direction in by_layer]
    return F.pad(torch.stack(of_any, 1), (1, 1, 1, 1))


def soft_coefficients(
    area: Tensor,
    lengths: Tensor,
    bins: Tensor,
    basis: Tensor,
    numbers: tuple[int, int],
    power: float,
) -> Tensor:
    """The descriptor of each image, ``(B, 6 * numbers[0] + 4 * numbers[1])`` of length 1 at most:
    the coefficients of histograms of ``area`` ``(B, 6, rows, columns)`` and ``lengths`` ``(B, 4,
    rows, columns)``; tables, numbers and power are those of `Harmonics`."""
    parts = [
        (safe_root(cells.flatten(2) @ bins.T) @ basis[:number].T).flatten(1)
        for cells, number in zip((area, lengths), numbers, strict=True)
    ]
    coefficients = torch.cat(parts, 1)
    damped = coefficients * (coefficients.square() + FAINT * FAINT) ** ((power - 1) / 2)
    return damped / (damped.square().sum(1, keepdim=True) + LEAST * LEAST).sqrt()


def safe_root(fractions: Tensor) -> Tensor:
    """The square root of numbers from 0, with a finite slope at 0."""
    return fractions / ((fractions + FAINT).sqrt() + math.sqrt(FAINT))
