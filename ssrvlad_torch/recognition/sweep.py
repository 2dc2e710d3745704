"""Sweep: a query described from several anchors, so that a turned camera still matches.

A reference has one descriptor; its score is that of the best anchor. Not in the paper.
"""

import torch
from torch import Tensor

from .matching import Rows, Vectors, unit_queries
from .motion import ELSEWHERE, lead, nearness
from .standardise import standardise

COLUMNS = tuple(range(-24, 25, 4))
"""Anchors of a query: columns of the working grid, relative to the vanishing column."""


@torch.no_grad()
def score(queries: Vectors, references: Vectors | Rows) -> Tensor:
    """Float32 cosines (Eq. 4) of queries to all references.

    Args:
        queries: ``(Q, D)`` float, or ``(Q, S, D)`` of a sweep, of which the best anchor counts.
        references: ``(R, D)`` float, or `Rows` of them for many calls.

    Returns:
        ``(Q, R)``; -inf for empty references and for empty queries, whose descriptors are zero.

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
    rows = references if isinstance(references, Rows) else Rows.of(fixed)
    scores = rows.cosines(unit_queries(swept).flatten(0, 1))
    return scores.view(*swept.shape[:2], len(rows)).amax(1)


@torch.no_grad()
def narrowed(
    queries: Tensor, references: Rows, columns: tuple[int, ...] = COLUMNS, standardised: bool = True
) -> tuple[Tensor, int]:
    """The sweep of one traverse, at the width that suits its scores best.

    A wide sweep finds a camera that is turned or moved aside, and costs a little where it is not.
    The width with the largest mean lead of the first candidates is taken, see `motion.lead`, over a
    sample of the queries. No label is used.

    Args:
        queries: ``(Q, S, D)`` raw descriptors of one traverse.
        references: R of them, standardised as the queries will be.
        columns: the S anchors, rising and symmetric about 0.
        standardised: whether to subtract the mean of the queries.

    Returns:
        ``(Q, S', D)``, and the width in columns on each side.

    Raises:
        ValueError: the number of columns is not that of anchors, or no column is 0.
    """
    if queries.ndim != 3 or queries.shape[1] != len(columns) or 0 not in columns:
        raise ValueError(
            f"expected (Q, {len(columns)}, D) for columns {columns}, one of which is 0, "
            f"got {tuple(queries.shape)}"
        )
    chosen, width, highest = queries, 0, -torch.inf
    for reach in sorted({abs(column) for column in columns}):
        part = queries[:, [abs(column) <= reach for column in columns]]
        part = standardise(part) if standardised else part
        mean_lead = _mean_lead(part[:: max(1, len(part) // _SAMPLE)], references)
        if mean_lead > highest:
            chosen, width, highest = part, reach, mean_lead
    return chosen, width


_SAMPLE = 200
_SCORES_AT_ONCE = 1 << 24


def _mean_lead(queries: Tensor, references: Rows) -> float:
    """The mean lead of the first candidates; 0 if there are too few references."""
    if len(references) <= 2 * ELSEWHERE + 1:
        return 0.0
    leads = []
    block = max(1, _SCORES_AT_ONCE // (len(references) * queries.shape[1]))
    for part in torch.split(queries, block):
        scores = score(part, references)
        leads.append(lead(nearness(scores[scores.amax(1).isfinite()])))
    finite = torch.cat([torch.zeros(0), *leads])
    finite = finite[finite.isfinite()]
    return float(finite.mean()) if len(finite) else 0.0
