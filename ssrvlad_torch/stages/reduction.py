"""Working size: a smaller grid by majority vote, which keeps thin poles better than sampling.

A pixel's vote is a number with one digit for each of a few kinds, so that sums over pixels count
several kinds at once. Votes are added over groups of so few pixels that no digit carries. Then the
digits are separated and added over the groups of a cell. All numbers are whole and exact in
float32, and no shape depends on the labels: eager torch and exported graphs run the same steps.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..taxonomy import NO_LAYER
from .tracing import length as size
from .tracing import looked_up, real

RADIX = 64
DIGITS = 4
"""Digits of a vote: ``RADIX ** DIGITS`` is 2 ** 24."""

ROWS, COLUMNS = 7, 9
"""Sides of the largest group of pixels, fewer than ``RADIX`` together."""


class Grouped(NamedTuple):
    """A side of the image in cells, and the pixels of each cell in groups of one length.

    Attributes:
        pixels: ``(groups, cells, length)`` int64, the pixels of each group of a cell.
        inside: ``(groups, cells, length)`` float32, 0 for an entry too many, else 1.
        sizes: ``(cells,)`` int64, the number of pixels of each cell.
        groups: the number of groups in a cell.
    """

    pixels: Tensor
    inside: Tensor
    sizes: Tensor
    groups: int


def ballots(table: Tensor) -> tuple[Tensor, Tensor]:
    """The votes of the entries of a table ``(T,)`` uint8 from `category_table`.

    Returns:
        ``(n, T)`` int32, the votes of each entry, and ``(DIGITS * n,)`` int64, the kind of each
        digit, of the lowest digits first. The last one counts the unknown ids; `NO_LAYER` has no
        votes, and stands for digits without a kind.
    """
    table = table.clamp(max=NO_LAYER + 1)
    kinds = sorted({*table.tolist()} - {NO_LAYER, NO_LAYER + 1})
    words = -(-(len(kinds) + 1) // DIGITS)
    kinds += [NO_LAYER] * (DIGITS * words - 1 - len(kinds)) + [NO_LAYER + 1]
    votes = torch.zeros(words, len(table), dtype=torch.int32)
    for place, kind in enumerate(kinds):
        if kind != NO_LAYER:
            votes[place % words, table == kind] = RADIX ** (place // words)
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
    images, height, width = entries.shape
    rows = grouped(height, grid[0], ROWS, entries.device)
    columns = grouped(width, grid[1], COLUMNS, entries.device)
    entry = entries.flatten()
    cast = (looked_up(word, entry).view(entries.shape) for word in votes.float())
    numbers = torch.cat(
        [_summed(_summed(ballot, rows).transpose(1, 2), columns) for ballot in cast]
    )
    places = RADIX ** -torch.arange(DIGITS, device=entries.device).float().view(-1, 1, 1, 1)
    higher = torch.floor(numbers * (places / RADIX))
    digits = (torch.floor(numbers * places) - higher * RADIX).to(real(height * width))
    counts = digits.view(len(kinds) * images, columns.groups, -1).sum(1)
    counts = counts.view(-1, rows.groups, grid[0]).sum(1).view(len(kinds), images, -1)
    of_layers, unknown = counts[:-1], counts[-1]
    area = (columns.sizes[:, None] * rows.sizes).flatten()
    counted = torch.cat((of_layers, (area - of_layers.sum(0))[None]))
    kind = kinds.clamp(max=NO_LAYER).to(counts).view(-1, 1, 1)
    most = torch.where(counted == counted.amax(0), kind, NO_LAYER)
    categories = most.amin(0).to(torch.uint8)  # argmax may take any of equal ones
    return categories.view(images, grid[1], -1).transpose(1, 2), unknown.sum(1).to(torch.int64)


def grouped(pixels: int, cells: int, most: int, device: torch.device) -> Grouped:
    """The pixels of a side in groups of at most ``most``; pixel x is in cell ``x * cells //
    pixels``."""
    longest = (pixels + cells - 1) // cells
    groups = size((longest + most - 1) // most)
    length = size((longest + groups - 1) // groups)
    product = torch.arange(cells + 1, device=device) * pixels + (cells - 1)
    estimate = torch.floor((product.to(real()) + 0.5) / cells).to(torch.int64)
    rest = product - estimate * cells  # runtimes round some quotients to the next whole number
    begin = estimate + (rest >= cells).long() - (rest < 0).long()
    within = torch.arange(groups * length, device=device).view(-1, 1, length)
    index = within + begin[:-1, None]
    inside = (index < begin[1:, None]).float()
    return Grouped(index.clamp(max=pixels - 1), inside, begin[1:] - begin[:-1], groups)


def _summed(numbers: Tensor, side: Grouped) -> Tensor:
    """``(N, pixels, n)`` -> ``(N, groups * cells, n)``, the sums over each group."""
    parts: Tensor = numbers.index_select(1, side.pixels.flatten())
    parts = parts.unflatten(1, (-1, side.pixels.shape[2]))
    return parts.mul_(side.inside.flatten(0, 1)[..., None]).sum(2)
