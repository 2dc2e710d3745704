"""Features: what the encoder of a segmentation network sees in each cell of a grid, as signs.

The activations become means over cells. Each channel is normalised over the cells of its own
picture, half of what the cells around it have in common is taken off, and each cell has length 1.
Projections of it, which the network's cells of pictures of noise give, keep their signs. All cells
share the projections, so a picture that is moved by cells has moved signs, and a mirrored one
mirrored signs. Not in the paper."""

import hashlib

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .grid_pooling import overlaps
from .tracing import exporting

COLUMNS, ROWS, SIGNS = 16, 16, 128
"""Columns and rows of cells, and signs of each cell."""

SHAPE = (COLUMNS, ROWS, SIGNS // 8)
"""Of a descriptor: sign ``k`` of a cell is bit ``k % 8``, from the lowest, of its byte ``k // 8``;
1 is positive."""

FORM = f"{ROWS} x {COLUMNS} cells alike, {SIGNS} signs"
"""How the fingerprints of features of this form begin: those of earlier ones do not compare."""

AROUND, SHARE = 5, 0.5
"""Rows and columns of the cells around a cell, and the share of their mean that is taken off."""

_NO_VARIANCE = 1e-5
_NO_LENGTH = 1e-12
_ROUNDING = 1e-5
_NO_COMPONENT = 1e-4


class Features(nn.Module):
    """Activations of one picture after another -> signs.

    Args:
        noise: the activations of pictures of noise that the network gives, ``(N, C, h, w)`` float,
            or their `cell_means`: one tensor for each activation.

    Shape:
        - input: for each of the activations ``(B, C, h, w)`` float, of any size.
        - output: ``(B, 16, 16, 16)`` uint8, see `SHAPE`.

    Raises:
        ValueError: an activation has another shape, is not finite, or does not vary over the
            picture, as where it is all zero. A graph cannot raise: there all signs are 0, which
            no other picture has.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.stages.features import Features
        >>> Features(torch.rand(2, 3, 24, 32))(torch.rand(1, 3, 24, 32)).shape
        torch.Size([1, 16, 16, 16])
    """

    def __init__(self, *noise: Tensor) -> None:
        super().__init__()
        self.channels = [level.shape[1] for level in noise]
        self.projections: Tensor
        self.bits: Tensor
        table = projections(unit_cells(self._checked_means(noise)))
        self.register_buffer("projections", table, persistent=False)
        self.register_buffer("bits", 2.0 ** torch.arange(8).float(), persistent=False)

    def extra_repr(self) -> str:
        """The channels and a digest of the projections."""
        table = self.projections.numpy(force=True).tobytes()
        return f"{self.channels}, {hashlib.blake2b(table, digest_size=8).hexdigest()}"

    def forward(self, *activations: Tensor) -> Tensor:
        """The signs of pictures."""
        is_exporting = exporting()
        if is_exporting:
            means = list(map(cell_means, activations))
        else:
            means = self._checked_means(activations)
        signs = unit_cells(means).permute(0, 3, 2, 1) @ self.projections > 0
        if is_exporting:
            usable = torch.stack([is_usable(level) for level in means]).all(0)
            signs = signs & usable[:, None, None, None]
        packed: Tensor = signs.unflatten(3, (-1, 8)).float() @ self.bits
        return packed.to(torch.uint8)

    def _checked_means(self, activations: tuple[Tensor, ...]) -> list[Tensor]:
        channels = [values.shape[1] if values.ndim == 4 else -1 for values in activations]
        if channels != self.channels:
            shapes = ", ".join(str(tuple(values.shape)) for values in activations) or "nothing"
            raise ValueError(
                f"expected activations (B, C, h, w) of {self.channels} channels, got {shapes}"
            )
        means = list(map(cell_means, activations))
        for level in means:
            if not bool(level.isfinite().all()):
                raise ValueError("the activations of the network are not finite")
            if not bool(is_usable(level).all()):
                raise ValueError("the activations of the network are the same everywhere")
        return means


def cell_means(activations: Tensor) -> Tensor:
    """``(B, C, ROWS, COLUMNS)`` float32, means of activations ``(B, C, h, w)`` over cells. A pixel
    counts in every cell that it overlaps, by the overlap."""
    height, width = activations.shape[2:]
    none = torch.zeros(1, dtype=torch.int64, device=activations.device)
    rows = overlaps(height, ROWS, none)[0].T.float() / height
    columns = overlaps(width, COLUMNS, none)[0].float() / width
    return (rows @ activations.float()) @ columns


def unit_cells(levels: list[Tensor]) -> Tensor:
    """``(B, sum of C, ROWS, COLUMNS)`` from the means ``(B, C, ROWS, COLUMNS)`` of activations.
    Each channel is without its mean over the cells, divided by its deviation, and without a `SHARE`
    of the mean of the cells around each; the cells of each activation have length 1."""
    return torch.cat(list(map(_unit_cells, levels)), 1)


def _unit_cells(means: Tensor) -> Tensor:
    centred = means - means.mean((2, 3), keepdim=True)
    variance = centred.square().mean((2, 3), keepdim=True)
    normal = centred / (variance + _NO_VARIANCE).sqrt()
    down, across = (_near(count).to(means.device) for count in (ROWS, COLUMNS))
    return F.normalize(normal - SHARE * (down @ normal @ across.T), dim=1, eps=_NO_LENGTH)


def _near(count: int) -> Tensor:
    """``(count, count)`` float32: times a line of cells, the mean of those that are near each."""
    cells = torch.arange(count)
    near = (2 * (cells[:, None] - cells).abs() < AROUND).float()
    return near / near.sum(1, keepdim=True)


def is_usable(means: Tensor) -> Tensor:
    """``(B,)`` bool, whether the means ``(B, C, ROWS, COLUMNS)`` of a picture are finite and not
    the same everywhere, but for rounding."""
    spread = (means.amax((2, 3)) - means.amin((2, 3))).amax(1)
    return (spread > _ROUNDING * means.abs().amax((1, 2, 3))) & means.sum((1, 2, 3)).isfinite()


def projections(cells: Tensor) -> Tensor:
    """``(C, SIGNS)`` float32, by which a cell is projected: the principal components of the cells
    ``(N, C, ROWS, COLUMNS)`` of a network, at most `SIGNS` of them, each divided by its deviation,
    and rotated.

    The rotation is the orthogonal matrix nearest to random sides, seen from the components. So the
    projections do not depend on the signs that a library gives to components, and change as little
    as the cells where another processor rounds otherwise."""
    flat = cells.permute(1, 0, 2, 3).flatten(1).double()
    variances, components = torch.linalg.eigh(flat @ flat.T / flat.shape[1])
    large = variances > _NO_COMPONENT * variances[-1]
    variances, components = variances[large][-SIGNS:], components[:, large][:, -SIGNS:]
    sides = random_sides(SIGNS * len(flat)).view(SIGNS, -1).T
    left, _, right = torch.linalg.svd(components.T @ sides.double(), full_matrices=False)
    table: Tensor = (components / variances.sqrt() @ left @ right).float()
    return table


def random_sides(count: int) -> Tensor:
    """``(count,)`` float32, 1 or -1 by the highest bit of each of `random_numbers`."""
    return torch.from_numpy(1 - 2 * (random_numbers(count) >> np.uint64(63)).astype(np.float32))


def random_numbers(count: int, first: int = 0) -> npt.NDArray[np.uint64]:
    """Numbers of SplitMix64 (Steele et al., OOPSLA 2014) from state 0, after ``first`` others: the
    same in every language."""
    steps = np.arange(first + 1, first + count + 1, dtype=np.uint64)
    mixed = steps * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ mixed >> np.uint64(shift)) * np.uint64(factor)
    return mixed ^ mixed >> np.uint64(31)
