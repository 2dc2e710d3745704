"""Working size: a smaller grid by majority vote, which keeps thin poles better than sampling."""

from __future__ import annotations

import torch
from torch import Tensor

from ..taxonomy import NO_LAYER


def reduce_by_majority(categories: Tensor, grid: tuple[int, int]) -> Tensor:
    """Reduces a category map to a grid; each cell takes the most common category of its pixels.

    Pixel ``(y, x)`` belongs to cell ``(y * h // H, x * w // W)``. Of equally common categories
    the lowest wins. The counts of several categories share an int64 word, each in as many bits
    as the largest cell needs, so one pass of additions over the map counts several categories.

    Args:
        categories: ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER`, which is counted like a category.
        grid: ``(h, w)`` with ``h <= H`` and ``w <= W``.

    Returns:
        ``(B, h, w)`` uint8.
    """
    if categories.shape[1:] == grid:
        return categories
    count, height, width = categories.shape
    bits = (-(-height // grid[0]) * -(-width // grid[1])).bit_length()
    kinds, fields = NO_LAYER + 1, 63 // bits
    rows = torch.arange(height, device=categories.device) * grid[0] // height
    columns = torch.arange(width, device=categories.device) * grid[1] // width
    entries = categories.flatten().to(torch.int32)
    best = torch.zeros((count, *grid), dtype=torch.int64, device=categories.device)
    for first in range(0, kinds, fields):
        counted = range(first, min(first + fields, kinds))
        words = torch.zeros(kinds, dtype=torch.int64, device=categories.device)
        for kind in counted:
            words[kind] = 1 << bits * (kind - first)
        votes = words.index_select(0, entries).view(categories.shape)
        by_row = votes.new_zeros((count, grid[0], width)).index_add_(1, rows, votes)
        by_cell = torch.zeros_like(best).index_add_(2, columns, by_row)
        for kind in counted:
            score = by_cell >> bits * (kind - first)
            score.bitwise_and_((1 << bits) - 1).mul_(kinds).add_(NO_LAYER - kind)
            torch.maximum(best, score, out=best)
    return (NO_LAYER - best % kinds).to(torch.uint8)
