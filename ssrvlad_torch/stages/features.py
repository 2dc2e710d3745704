"""Features: what the encoder of a segmentation network sees in each cell of a grid, as signs.

The activations become means over cells. Each channel is normalised over the cells of its own
picture, each cell has length 1, and random projections of it keep their signs. The cells of a row
share the projections, so a picture that is moved by a column of cells has moved signs, and a
mirrored one mirrored signs. Not in the paper.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .grid_pooling import overlaps

COLUMNS, ROWS, SIGNS = 16, 16, 64
"""Columns and rows of cells, and signs of each cell."""

SHAPE = (COLUMNS, ROWS, SIGNS // 8)
"""Of a descriptor: sign ``k`` of a cell is bit ``k % 8``, from the lowest, of its byte ``k // 8``;
1 is positive."""

_NO_VARIANCE = 1e-5
_NO_LENGTH = 1e-12
_ROUNDING = 1e-5


class Features(nn.Module):
    """Activations of one picture after another -> signs.

    Shape:
        - input: for each of the numbers of ``channels`` an activation ``(B, C, h, w)`` float, of
          any size.
        - output: ``(B, 16, 16, 8)`` uint8, see `SHAPE`.

    Raises:
        ValueError: an activation has another shape, is not finite, or does not vary over the
            picture, as where it is all zero. A graph cannot raise: there all signs are 0, which
            no other picture has.

    Examples:
        >>> Features([3])(torch.rand(2, 3, 24, 32)).shape
        torch.Size([2, 16, 16, 8])
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
        is_exporting = torch.compiler.is_exporting()
        got = [each.shape[1] if each.ndim == 4 else -1 for each in activations]
        if not is_exporting and got != self.channels:
            shapes = ", ".join(str(tuple(each.shape)) for each in activations) or "nothing"
            raise ValueError(
                f"expected activations (B, C, h, w) of {self.channels} channels, got {shapes}"
            )
        means = [cell_means(each) for each in activations]
        if not is_exporting:
            for each in means:
                if not bool(each.isfinite().all()):
                    raise ValueError("the activations of the network are not finite")
                if not bool(is_usable(each).all()):
                    raise ValueError("the activations of the network are the same everywhere")
        cells = torch.cat([unit_cells(each) for each in means], 1)
        signs = cells.permute(2, 0, 3, 1).flatten(1, 2) @ self.projections > 0
        by_row = signs.unflatten(1, (-1, COLUMNS)).permute(1, 2, 0, 3)
        if is_exporting:
            usable = torch.stack([is_usable(each) for each in means]).all(0)
            by_row = by_row & usable[:, None, None, None]
        packed: Tensor = by_row.unflatten(3, (-1, 8)).float() @ self.bits
        return packed.to(torch.uint8)


def cell_means(activations: Tensor) -> Tensor:
    """``(B, C, ROWS, COLUMNS)`` float32, means of activations ``(B, C, h, w)`` over cells. A pixel
    counts in every cell that it overlaps, by the overlap."""
    height, width = activations.shape[2:]
    none = torch.zeros(1, dtype=torch.int64, device=activations.device)
    rows = overlaps(height, ROWS, none)[0].T / height
    columns = overlaps(width, COLUMNS, none)[0] / width
    return rows @ (activations.float() @ columns)


def unit_cells(means: Tensor) -> Tensor:
    """``(B, C, ROWS, COLUMNS)`` means, each channel without its mean over the cells and divided by
    its deviation, each cell of length 1."""
    centred = means - means.mean((2, 3), keepdim=True)
    variance = centred.square().mean((2, 3), keepdim=True)
    return F.normalize(centred / (variance + _NO_VARIANCE).sqrt(), dim=1, eps=_NO_LENGTH)


def is_usable(means: Tensor) -> Tensor:
    """``(B,)`` bool, whether the means ``(B, C, ROWS, COLUMNS)`` of a picture are finite and not
    the same everywhere, but for rounding."""
    spread = (means.amax((2, 3)) - means.amin((2, 3))).amax(1)
    return (spread > _ROUNDING * means.abs().amax((1, 2, 3))) & means.sum((1, 2, 3)).isfinite()


def projections(channels: int) -> Tensor:
    """``(ROWS, channels, SIGNS)`` float32, 1 or -1 by the highest bit of SplitMix64 (Steele et al.,
    OOPSLA 2014) of the entry's number: the same in every language."""
    count = ROWS * SIGNS * channels
    mixed = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ mixed >> np.uint64(shift)) * np.uint64(factor)
    high = (mixed ^ mixed >> np.uint64(31)) >> np.uint64(63)
    signs = torch.from_numpy(1 - 2 * high.astype(np.float32))
    return signs.view(ROWS, SIGNS, channels).transpose(1, 2).contiguous()
