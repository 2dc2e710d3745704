"""Sweep: a query described from several anchors, so that a camera that is turned still fits.

References stay one descriptor each, and a reference scores its best anchor. Not in the paper.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .matching import Rows, Vectors, wanted
from .motion import ELSEWHERE, lead, nearness
from .standardise import standardise

COLUMNS = tuple(range(-24, 25, 4))
"""Anchors of a query: columns of the working grid from the vanishing column."""


@torch.no_grad()
def score(queries: Vectors, references: Vectors | Rows) -> Tensor:
    """``(Q, R)`` float32 cosines (Eq. 4) of queries to all references.

    Args:
        queries: ``(Q, D)`` float, or ``(Q, S, D)`` of a sweep: each reference scores its best.
        references: ``(R, D)`` float, or `Rows` of them, for many calls.

    Returns:
        -inf for empty references and for empty queries, whose descriptors are zero.

    Raises:
        ValueError: the shapes do not fit, or values are not finite.
    """
    swept = torch.as_tensor(queries)
    swept = swept[:, None] if swept.ndim == 2 else swept
    fixed = references.vectors if isinstance(references, Rows) else torch.as_tensor(references)
    if swept.ndim != 3 or fixed.ndim != 2 or swept.shape[2] != fixed.shape[1]:
        raise ValueError(
            "expected queries (Q, D) or (Q, S, D) and references (R, D) of one width D, got "
            f"{tuple(swept.shape)} and {tuple(fixed.shape)}"
        )
    known = references if isinstance(references, Rows) else Rows.of(fixed)
    scores = known.cosines(wanted(swept).flatten(0, 1))
    return scores.view(*swept.shape[:2], len(known)).amax(1)


@torch.no_grad()
def narrowed(
    queries: Vectors,
    references: Vectors | Rows,
    columns: tuple[int, ...] = COLUMNS,
    standardised: bool = True,
) -> tuple[Tensor, int]:
    """The sweep of one traverse, as wide as its own scores ask for.

    A wide sweep finds a camera that is turned or moved aside, and costs a little where it is not.
    That width is taken at which the first candidate is farthest ahead of the best row elsewhere:
    the mean, over up to `_SAMPLE` queries, of the difference of their nearness. No label is used.

    Args:
        queries: ``(Q, S, D)`` raw descriptors of one traverse.
        references: ``(R, D)``, standardised as the queries will be, or `Rows` of them.
        columns: the S anchors, rising and symmetric about 0.
        standardised: take the mean of the queries off.

    Returns:
        ``(Q, S', D)``, and the width in columns on each side.

    Raises:
        ValueError: there are not as many columns as anchors, or none is 0.
    """
    swept = torch.as_tensor(queries)
    if swept.ndim != 3 or swept.shape[1] != len(columns) or 0 not in columns:
        raise ValueError(
            f"expected (Q, {len(columns)}, D) for columns {columns}, one of which is 0, "
            f"got {tuple(swept.shape)}"
        )
    known = references if isinstance(references, Rows) else Rows.of(references)
    chosen, most = swept, -torch.inf
    width = 0
    for reach in sorted({abs(column) for column in columns}):
        part = swept[:, [abs(column) <= reach for column in columns]]
        part = standardise(part) if standardised else part
        ahead = _lead(part[:: max(1, len(part) // _SAMPLE)], known)
        if ahead > most:
            chosen, most, width = part, ahead, reach
    return chosen, width


_SAMPLE = 200
_SCORES = 1 << 24


def _lead(queries: Tensor, references: Rows) -> float:
    """How far first candidates are ahead, on average; 0 if there are too few references."""
    if len(references) <= 2 * ELSEWHERE + 1:
        return 0.0
    leads = []
    few = max(1, _SCORES // (len(references) * queries.shape[1]))
    for part in torch.split(queries, few):
        scores = score(part, references)
        leads.append(lead(nearness(scores[scores.amax(1).isfinite()])))
    ahead = torch.cat(leads) if leads else torch.zeros(0)
    return float(ahead[ahead.isfinite()].mean()) if ahead.isfinite().any() else 0.0
