"""Working size: a smaller grid by majority vote, so that no thin pole vanishes by sampling luck."""

from __future__ import annotations

import torch
from torch import Tensor

from ..taxonomy import NO_LAYER


def reduce_by_majority(categories: Tensor, grid: tuple[int, int]) -> Tensor:
    """Reduces a category map to a grid whose cells take the commonest category of their pixels.

    Pixel ``(y, x)`` belongs to cell ``(y * h // H, x * w // W)``. The lowest of equally common
    categories wins. The counts of several categories share an int64 word, each in as many bits
    as the largest cell needs, so one pass of additions over the map counts them all.

    Args:
        categories: ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER`, which has a vote like any other.
        grid: ``(h, w)`` with ``h <= H`` and ``w <= W``.

    Returns:
        ``(B, h, w)`` uint8.
    """
    count, height, width = categories.shape
    if (height, width) == grid:
        return categories
    bits = (-(-height // grid[0]) * -(-width // grid[1])).bit_length()
    kinds, fields = NO_LAYER + 1, 63 // bits
    cell_rows = torch.arange(height, device=categories.device) * grid[0] // height
    cell_columns = torch.arange(width, device=categories.device) * grid[1] // width
    counts = []
    for first in range(0, kinds, fields):
        shifts = torch.arange(min(fields, kinds - first), device=categories.device) * bits
        words = torch.zeros(kinds, dtype=torch.int64, device=categories.device)
        words[first : first + fields] = 1 << shifts
        votes = words.index_select(0, categories.flatten().to(torch.int32)).view(categories.shape)
        by_row = votes.new_zeros((count, grid[0], width)).index_add_(1, cell_rows, votes)
        by_cell = votes.new_zeros((count, *grid)).index_add_(2, cell_columns, by_row)
        counts.append(by_cell[..., None] >> shifts & ((1 << bits) - 1))
    return torch.cat(counts, -1).argmax(-1).to(torch.uint8)
