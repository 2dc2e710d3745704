"""Ways to store the cells of features in few bytes, and their comparison."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import features
import numpy as np
import torch
import torch.nn.functional as F
from _described import Described
from torch import Tensor

from ssrvlad_torch.channels.signs import REACH
from ssrvlad_torch.stages import features as stage

MOST = 256
"""Components that are kept."""

CUTS = torch.tensor([-0.6745, 0.0, 0.6745])
LEVELS = torch.tensor([-1.271, -0.325, 0.325, 1.271])
"""Where a normal variable is cut in quarters, and its mean in each."""


class Form(NamedTuple):
    """How cells are stored.

    ``signs``: numbers of a cell, 0 for floats. ``of``: whose components they are made of, those of
    the "noise" or of the "map", or of none, "". ``turns``: of ITQ. ``cut``: two bits each, by the
    quarters of a "normal" variable that has the deviation of the picture, or of the "map".
    ``pool``: rows and columns of cells that are averaged.
    """

    signs: int = 128
    components: int = 128
    of: str = "noise"
    equal: bool = True
    turns: int = 0
    cut: str = ""
    pool: tuple[int, int] = (1, 1)
    weighed: bool = False

    @property
    def size(self) -> int:
        """Bytes of a picture."""
        return self.signs * (1 + bool(self.cut)) * 32 // (self.pool[0] * self.pool[1])

    @property
    def needs_map(self) -> bool:
        """Whether another map gives another form."""
        return "map" in (self.of, self.cut) or self.weighed


class Source:
    """The cells of drives by a network."""

    def __init__(self, described: Described, network: str) -> None:
        self.described, self.network = described, network


def scores(source: Source, form: Form, queries: str, references: str, seed: int) -> Tensor:
    """``(2, Q, R)`` cosines for the best move, raw and without the mean of each drive."""
    ours, theirs = stored(source, form, queries, references, seed)
    reach = REACH // form.pool[1]
    best, count = torch.full((2, len(ours), len(theirs)), -1.0), ours.shape[1]
    for move in range(-reach, reach + 1):
        a = ours[:, max(0, -move) : count - max(0, move)].flatten(1)
        b = theirs[:, max(0, move) : count - max(0, -move)].flatten(1)
        products = a @ b.T
        for way, (m, n) in enumerate(((0 * a[0], 0 * b[0]), (a.mean(0), b.mean(0)))):
            of_a = a.square().sum(1) - 2 * a @ m + m @ m
            of_b = b.square().sum(1) - 2 * b @ n + n @ n
            dots = products - (a @ n)[:, None] - b @ m + m @ n
            best[way] = torch.maximum(best[way], dots / (of_a[:, None] * of_b).sqrt())
    return best


def stored(source: Source, form: Form, queries: str, references: str, seed: int) -> list[Tensor]:
    """``(N, columns, D)`` of the queries and of the references, as a form stores them."""
    by = references if form.of == "map" else form.of
    both = [coordinates(source, folder, by, form.pool) for folder in (queries, references)]
    if form.signs:
        table = projections(source, form, by, seed)
        both = [each[..., -table.shape[1] :] @ table[:, None] for each in both]
        if form.cut == "map":
            edges = both[1].flatten(1, 2).quantile(torch.tensor([0.25, 0.5, 0.75]), 1)
            both = [LEVELS[(each > edges[:, :, None, None]).sum(0)] for each in both]
        elif form.cut:
            deviations = [each.square().mean((0, 2, 3), keepdim=True).sqrt() for each in both]
            both = [
                LEVELS[torch.bucketize(x / y, CUTS)] for x, y in zip(both, deviations, strict=True)
            ]
        else:
            both = [torch.where(each > 0, 1.0, -1.0) for each in both]
    if form.weighed:
        both[1] = both[1] * both[1].var(1, keepdim=True).mean(3, keepdim=True)
    return [each.permute(1, 2, 0, 3).flatten(2) for each in both]


def projections(source: Source, form: Form, by: str, seed: int) -> Tensor:
    """``(rows, k, signs)``, of the last k coordinates."""
    components, variances = basis(source, by, form.pool)
    if by:
        components, variances = (x[..., -form.components :] for x in (components, variances))
    shape = (stage.ROWS // form.pool[0], form.signs, len(components))
    count = int(np.prod(shape))
    drawn = stage.random_numbers(count, seed * count) >> np.uint64(63)
    sides = 1 - 2 * torch.from_numpy(drawn.astype(np.float64)).view(shape).transpose(1, 2)
    rotations = nearest(components.T @ sides)
    for _ in range(form.turns):
        values = coordinates(source, by, by, form.pool)[..., -form.components :].flatten(1, 2)
        signs = (values @ rotations.float()).sign()
        rotations = nearest((values.transpose(1, 2) @ signs).double())
    return (rotations / variances.sqrt()[:, None] if form.equal else rotations).float()


def nearest(matrices: Tensor) -> Tensor:
    """The matrices with orthonormal rows or columns that are nearest to some."""
    left, _, right = torch.linalg.svd(matrices, full_matrices=False)
    found: Tensor = left @ right
    return found


@lru_cache(64)
def cells(source: Source, folder: str, pool: tuple[int, int]) -> Tensor:
    """``(N, C, rows, columns)``, unit cells, of pooled ones again."""
    given = stage.unit_cells(list(features.means(source.described, source.network, folder)))
    return given if pool == (1, 1) else F.normalize(F.avg_pool2d(given, pool), dim=1)


@lru_cache(64)
def basis(source: Source, by: str, pool: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The components ``(C, k)`` of a drive and their variances, ascending; of none all axes."""
    flat = cells(source, by or "noise", pool).transpose(0, 1).flatten(1).double()
    if not by:
        return torch.eye(len(flat)).double(), torch.ones(len(flat)).double()
    variances, components = torch.linalg.eigh(flat @ flat.T / flat.shape[1])
    kept = variances > 1e-4 * variances[-1]
    return components[:, kept][:, -MOST:], variances[kept][-MOST:]


@lru_cache(128)
def coordinates(source: Source, folder: str, by: str, pool: tuple[int, int]) -> Tensor:
    """``(rows, N, columns, k)`` of the cells of a drive by the basis of another."""
    given = cells(source, folder, pool).permute(2, 0, 3, 1)
    return given @ basis(source, by, pool)[0].float() if by else given.contiguous()
