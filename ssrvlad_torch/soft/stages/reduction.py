"""Soft majority: layers on the working grid, from the fractions of each cell's pixels."""

import torch
from torch import Tensor

TINY = 1e-6


def soft_majority(layers: Tensor, grid: tuple[int, int], temperature: float) -> Tensor:
    """``(B, 8, h, w)``, the fraction of each cell of the grid that each category covers, of layers
    ``(B, 8, H, W)``, 0 to 1; a low temperature favours the largest.

    This is the softmax in place of the vote of `reduce_by_majority`: fractions to the power of ``1
    / temperature``, normalised. At temperature 1 they are the mean of the pixels. Pixel ``(y, x)``
    belongs to cell ``(y * h // H, x * w // W)``.
    """
    if tuple(layers.shape[2:]) == grid:
        return layers
    rows, columns = (
        _means(pixels, cells, layers) for pixels, cells in zip(layers.shape[2:], grid, strict=True)
    )
    fractions = rows @ layers @ columns.T
    rest = (1 - fractions.sum(1, keepdim=True)).clamp(min=0)
    votes = (torch.cat([fractions, rest], 1).clamp(min=0) + TINY).log() / temperature
    return votes.softmax(1)[:, :-1]


def _means(pixels: int, cells: int, like: Tensor) -> Tensor:
    """``(cells, pixels)`` matrix that takes the mean over the pixels of each cell of a line."""
    cell = torch.arange(pixels, device=like.device) * cells // pixels
    belongs = (cell == torch.arange(cells, device=like.device)[:, None]).to(like)
    return belongs / belongs.sum(1, keepdim=True)
