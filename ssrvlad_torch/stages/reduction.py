"""Working size: a smaller grid by majority vote, which keeps thin poles better than sampling.

A pixel's vote is a number with one digit for each of a few kinds, so that sums over pixels count
several kinds at once. Votes are added over groups of so few pixels that no digit carries. Then the
digits are separated and added over the groups of a cell. All numbers are whole and exact in
float32, and no shape depends on the labels: eager torch and exported graphs run the same steps.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..taxonomy import NO_LAYER
from .tracing import length as size
from .tracing import real

RADIX = 64
DIGITS = 4
"""Digits of a vote: ``RADIX ** DIGITS`` is 2 ** 24."""

ROWS, COLUMNS = 7, 9
"""Sides of the largest group of pixels, fewer than ``RADIX`` together."""


class Grouped(NamedTuple):
    """A side of the image in cells, and the pixels of each cell in groups of one length.

    Attributes:
        pixels: ``(cells * groups, length)`` int64, the pixels of each group.
        inside: the same shape, 1 for a pixel of the group, 0 for an entry too many.
        groups: the number of groups in a cell.
    """

    pixels: Tensor
    inside: Tensor
    groups: int


def ballots(table: Tensor) -> tuple[Tensor, Tensor]:
    """The votes of the entries of a table of categories.

    Args:
        table: ``(T,)`` uint8: 0 to 7, `NO_LAYER`, or a larger number for an unknown id.

    Returns:
        ``(n, T)`` int32, the votes of each entry, and ``(K,)`` int64, the kinds in the order of the
        digits. The last kind are the unknown ids; `NO_LAYER` has no votes.
    """
    table = table.clamp(max=NO_LAYER + 1)
    kinds = sorted({*table.tolist(), NO_LAYER + 1} - {NO_LAYER})
    votes = torch.zeros(-(-len(kinds) // DIGITS), len(table), dtype=torch.int32)
    for place, kind in enumerate(kinds):
        votes[place // DIGITS, table == kind] = RADIX ** (place % DIGITS)
    return votes, torch.tensor(kinds)


def reduce_by_majority(
    entries: Tensor, votes: Tensor, kinds: Tensor, grid: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Reduces label maps to a grid; each cell takes the most common category of its pixels.

    Pixel ``(y, x)`` belongs to cell ``(y * h // H, x * w // W)``. Of equally common categories
    the lowest wins. `NO_LAYER` is counted like a category, and so are pixels with unknown ids.

    Args:
        entries: ``(B, H, W)`` int64, the index of each pixel in the table.
        votes, kinds: from `ballots`, for this table.
        grid: ``(h, w)`` with ``h <= H`` and ``w <= W``.

    Returns:
        ``(B, h, w)`` uint8, 0 to `NO_LAYER`, and ``(B,)`` int64, the number of unknown pixels.
    """
    rows = grouped(entries.shape[1], grid[0], ROWS, entries.device)
    columns = grouped(entries.shape[2], grid[1], COLUMNS, entries.device)
    sums = []
    for word in votes.float():
        cast = word.index_select(0, entries.flatten()).view(entries.shape)
        sums.append(_summed(_summed(cast, rows).transpose(1, 2), columns))
    numbers, digits = torch.stack(sums, 1), []
    for _ in range(DIGITS):
        higher = torch.floor(numbers * (1 / RADIX))
        digits.append(numbers - higher * RADIX)
        numbers = higher
    number = real(entries.shape[1] * entries.shape[2])
    counts = torch.stack(digits, 2).flatten(1, 2)[:, : len(kinds)].to(number)
    counts = counts.unflatten(3, (grid[0], rows.groups)).unflatten(2, (grid[1], columns.groups))
    counts = counts.sum((3, 5))  # (B, K, w, h)
    tall, wide = (
        side.inside.sum(1).unflatten(0, (cells, side.groups)).sum(1).to(number)
        for side, cells in ((rows, grid[0]), (columns, grid[1]))
    )
    of_layers = counts[:, :-1]
    none = wide[:, None] * tall - of_layers.sum(1)
    counted = torch.cat((of_layers, none[:, None]), 1)
    each = kinds.clamp(max=NO_LAYER).to(number).view(-1, 1, 1)
    most = torch.where(counted == counted.amax(1, keepdim=True), each, NO_LAYER)
    categories = most.amin(1).transpose(1, 2).to(torch.uint8)  # argmax may take any of equal ones
    return categories, counts[:, -1].to(torch.int64).sum((1, 2))


def grouped(pixels: int, cells: int, most: int, device: torch.device) -> Grouped:
    """The pixels of a side in groups of at most ``most``; pixel x is in cell ``x * cells //
    pixels``."""
    longest = (pixels + cells - 1) // cells
    groups = size((longest + most - 1) // most)
    length = size((longest + groups - 1) // groups)
    product = torch.arange(cells + 1, device=device) * pixels + (cells - 1)
    estimate = torch.floor((product.to(real()) + 0.5) / cells).to(torch.int64)
    rest = product - estimate * cells  # runtimes round some quotients to the next whole number
    begin = (estimate + (rest >= cells).long() - (rest < 0).long())[:, None]
    index = begin[:-1] + torch.arange(groups * length, device=device)
    inside = (index < begin[1:]).to(real())
    index = index.clamp(max=pixels - 1)
    shape = (cells * groups, length)
    return Grouped(index.view(shape), inside.view(shape), groups)


def _summed(numbers: Tensor, side: Grouped) -> Tensor:
    """``(B, pixels, n)`` -> ``(B, cells * groups, n)``, the sums over each group."""
    parts = numbers.index_select(1, side.pixels.flatten())
    grouped: Tensor = parts.unflatten(1, side.pixels.shape)
    return grouped.mul_(side.inside[..., None].float()).sum(2)
