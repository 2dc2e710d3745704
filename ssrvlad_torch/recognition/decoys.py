"""Decoys: a map of places that do not exist, to see what chance finds.

The map in a mirror has the same statistics as the map, and none of its frames can be right. Wrong
answers fall on both alike, so the queries whose best answer is a mirrored frame count the wrong
answers without ground truth: the target-decoy competition of Elias and Gygi (Nature Methods 2007).
For sequences the decoy is the map run backwards, see `follow`.

No picture is mirrored: the descriptor of a mirrored picture is that of the picture with signs
changed and numbers exchanged. Each method has a function for it, a `Mirror`. Since it keeps scalar
products, the queries are mirrored instead of the map.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .matching import Rows, unit_queries
from .motion import ELSEWHERE, moments, nearness

Mirror = Callable[[Tensor], Tensor]
"""From descriptors ``(..., D)`` to those of the mirrored pictures."""


class Lead(NamedTuple):
    """How a query's best row of the map compares with its best decoy.

    Attributes:
        value: how far the nearer of the two is ahead of all other places and decoys, in standard
            deviations of the nearness; negative if it is the decoy. NaN without a candidate.
        decoy: row whose mirrored descriptor is the nearest; -1 without one.
    """

    value: float
    decoy: int


def lead_over_decoys(
    scores: Tensor,
    decoys: Tensor | None = None,
    rows: Tensor | None = None,
    decoy_rows: Tensor | None = None,
    deviation: float | None = None,
) -> Lead:
    """The lead of one query's best row over the decoys.

    Args:
        scores: ``(N,)`` float cosines of the query, -inf where there can be no match.
        decoys: ``(M,)`` float, those of the mirrored rows; without, the lead is over other places.
        rows, decoy_rows: ``(N,)`` and ``(M,)`` int64, rising, of the map; without, all rows.
        deviation: of the nearness of all rows and decoys; without, of these scores.

    Examples:
        >>> lead_over_decoys(torch.eye(20)[3], torch.zeros(20)).value > 1
        True
    """
    decoys = scores[:0] if decoys is None else decoys
    own, elsewhere, row = _best(scores, rows)
    decoy, other_decoy, decoy_row = _best(decoys, decoy_rows)
    if row < 0:
        return Lead(torch.nan, decoy_row)
    if deviation is None:
        _, deviation = moments(torch.cat((scores, decoys)))
    ahead = own - max(decoy, elsewhere) if own > decoy else max(own, other_decoy) - decoy
    return Lead(ahead / deviation if abs(ahead) < torch.inf else torch.nan, decoy_row)


def _best(scores: Tensor, rows: Tensor | None) -> tuple[float, float, int]:
    """The nearness of the nearest row and of the nearest that is elsewhere, and the first's row."""
    if not bool((scores > -torch.inf).any()):
        return -torch.inf, -torch.inf, -1
    near = nearness(scores.float())
    best = int(near.argmax())
    if rows is None:
        apart = torch.cat((near[: max(0, best - ELSEWHERE)], near[best + ELSEWHERE + 1 :]))
    else:
        apart = near[(rows - rows[best]).abs() > ELSEWHERE]
    elsewhere = float(apart.max()) if len(apart) else -torch.inf
    return float(near[best]), elsewhere, best if rows is None else int(rows[best])


def decoy_scores(
    queries: Tensor, references: Rows, mirror: Mirror, mean: Tensor | None = None
) -> Tensor:
    """``(Q, R)`` float32 cosines of queries ``(Q, D)``, or ``(Q, S, D)`` of a sweep, of which the
    best anchor counts, to the mirrored references. ``mean`` ``(D,)`` is what these have in common,
    if it was not subtracted; it is not mirrored: only what makes the places differ is."""
    swept = queries[:, None] if queries.ndim == 2 else queries
    units = unit_queries(swept)
    turned = mirror(units)
    scores = references.cosines(turned.flatten(0, 1)).view(*swept.shape[:2], -1)
    if mean is not None:
        # the length of a decoy is |mean + mirror(unit row - mean)|
        both = torch.stack((mean, mirror(mean)))
        along, across = (references.vectors.float() @ both.T / references.lengths[:, None]).T
        squares = 1 + 2 * float(mean @ mean) - 2 * along + 2 * across - 2 * float(mean @ both[1])
        lengths = squares.clamp(min=_ROUNDING).sqrt().nan_to_num(1.0)
        shift = ((units - turned) @ mean).nan_to_num(0.0)
        scores = (scores + shift[..., None]) / lengths
    return scores.amax(1)


_ROUNDING = 1e-12
