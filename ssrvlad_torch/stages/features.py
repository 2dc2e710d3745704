"""Features: what the encoder of a segmentation network sees in each cell of a grid, as signs.

The activations become means over cells. Each channel is normalised over the cells of its own
picture, each cell has length 1, and random projections of it keep their signs. All cells share the
projections, so a picture that is moved by a column of cells has moved signs, and a mirrored one
mirrored signs. Not in the paper.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .grid_pooling import overlaps

ROWS, COLUMNS, SIGNS = 12, 16, 85
"""Rows and columns of cells, and signs of each cell."""

BYTES = ROWS * COLUMNS * SIGNS // 8
"""Length of a descriptor. Sign ``k`` of the cell in row ``r`` and column ``c`` is bit ``i % 8`` of
byte ``i // 8``, counted from the lowest, with ``i = (r * COLUMNS + c) * SIGNS + k``."""

REACH = 2
"""Columns of cells by which a query is moved to each side."""

_MIN_DEVIATION = 1e-6
_MIN_LENGTH = 1e-6


class Features(nn.Module):
    """Activations of one picture after another -> signs.

    Args:
        channels: number of channels of each activation.

    Shape:
        - input: for each of ``channels`` an activation ``(B, C, h, w)`` float, of any size.
        - output: ``(B, BYTES)`` uint8.

    Raises:
        ValueError: an activation has another shape, is not finite, or does not vary over the
            picture, as where it is all zero. A graph cannot raise.

    Example:
        >>> Features([3])(torch.rand(2, 3, 24, 32)).shape
        torch.Size([2, 2040])
    """

    def __init__(self, channels: list[int]) -> None:
        super().__init__()
        self.channels = channels
        self.projections: Tensor
        self.bits: Tensor
        self.register_buffer("projections", projections(sum(channels)), persistent=False)
        self.register_buffer("bits", 2.0 ** torch.arange(8), persistent=False)

    def forward(self, *activations: Tensor) -> Tensor:
        """The signs of pictures."""
        cells = torch.cat([unit_cells(each) for each in self._checked(activations)], 1)
        signs = cells.flatten(2).transpose(1, 2) @ self.projections > 0
        return (signs.reshape(-1, BYTES, 8).float() @ self.bits).to(torch.uint8)

    def _checked(self, activations: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        if torch.compiler.is_exporting():
            return activations
        got = [each.shape[1] if each.ndim == 4 else -1 for each in activations]
        if got != self.channels:
            shapes = ", ".join(str(tuple(each.shape)) for each in activations) or "nothing"
            raise ValueError(
                f"expected activations (B, C, h, w) of {self.channels} channels, got {shapes}"
            )
        for each in activations:
            if not bool(each.isfinite().all()):
                raise ValueError("the activations of the network are not finite")
            if bool((each == each[:, :, :1, :1]).flatten(1).all(1).any()):
                raise ValueError("the activations of the network are the same everywhere")
        return activations


def unit_cells(activations: Tensor) -> Tensor:
    """``(B, C, ROWS, COLUMNS)`` float32: means over cells, each channel without its mean over the
    cells and divided by its deviation, each cell of length 1.

    A pixel counts in every cell that it overlaps, by the overlap. A channel or a cell without
    variation is zero.
    """
    height, width = activations.shape[2:]
    none = torch.zeros(1, dtype=torch.int64, device=activations.device)
    rows = overlaps(height, ROWS, none)[0].T / height
    columns = overlaps(width, COLUMNS, none)[0] / width
    cells = rows @ (activations.float() @ columns)
    centred = cells - cells.mean((2, 3), keepdim=True)
    deviation = centred.square().mean((2, 3), keepdim=True).sqrt()
    return F.normalize(centred / deviation.clamp(min=_MIN_DEVIATION), dim=1, eps=_MIN_LENGTH)


def projections(channels: int) -> Tensor:
    """``(channels, SIGNS)`` float32, 1 or -1 by the highest bit of SplitMix64 (Steele et al.,
    OOPSLA 2014) of the entry's number: the same in every language."""
    mixed = np.arange(1, channels * SIGNS + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ mixed >> np.uint64(shift)) * np.uint64(factor)
    high = (mixed ^ mixed >> np.uint64(31)) >> np.uint64(63)
    return torch.from_numpy(high.astype(np.float32) * 2 - 1).view(channels, SIGNS)
