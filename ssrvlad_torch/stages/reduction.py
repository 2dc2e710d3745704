"""Working size: a smaller grid by majority vote, which keeps thin poles better than sampling."""

import torch
from torch import Tensor

from ..taxonomy import NO_LAYER


def reduce_by_majority(layers: Tensor, grid: tuple[int, int]) -> Tensor:
    """``(B, h, w)`` uint8, 0 to `NO_LAYER`: layers ``(B, H, W)`` int32 reduced to a grid ``(h,
    w)``, not larger; each cell takes the most common layer of its pixels.

    Pixel ``(y, x)`` belongs to cell ``(y * h // H, x * w // W)``. `NO_LAYER` is counted like a
    layer; of equally common ones the lowest wins."""
    images, height, width = layers.shape
    rows, columns = grid
    kinds = torch.arange(NO_LAYER + 1, dtype=torch.int32, device=layers.device)
    cell = cells(height, rows, layers.device)[:, None] * columns
    cell = cell + cells(width, columns, layers.device)
    votes = (cell * len(kinds) + layers).flatten(1)
    counts = torch.zeros(images, rows * columns * len(kinds), dtype=torch.int32)
    counts = counts.to(layers.device).scatter_add(1, votes, torch.ones_like(layers).flatten(1))
    counts = counts.view(images, rows, columns, len(kinds))
    most = torch.where(counts == counts.amax(3, keepdim=True), kinds, NO_LAYER)
    return most.amin(3).to(torch.uint8)  # argmax may take any of equal ones


def cells(pixels: int, count: int, device: torch.device) -> Tensor:
    """``(pixels,)`` int64, the cell ``x * count // pixels`` of each pixel ``x`` of a side. It is
    counted, as OpenVINO divides integers in float32."""
    x = torch.arange(pixels, device=device)[:, None] * count
    firsts = torch.arange(1, count, device=device) * pixels
    return (x >= firsts).sum(1)
