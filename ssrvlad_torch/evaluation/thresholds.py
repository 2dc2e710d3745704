"""Statistics to choose the score from which on a candidate is believed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from .bootstrap import LEVEL
from .curves import PrecisionRecall
from .outcomes import Floats

SURE_PRECISION = 0.95
_Z2 = NormalDist().inv_cdf((1 + LEVEL) / 2) ** 2


class OperatingPoint(NamedTuple):
    """What happens when candidates from a score on are believed.

    Attributes:
        score: candidates that score this or more are accepted.
        precision, recall: 0 to 1.
        precision_low: lower end of the 95 % interval of the precision, see `wilson_low`.
        accepted: number of queries whose best candidate is accepted.
    """

    score: float
    precision: float
    precision_low: float
    recall: float
    accepted: int


def at_precision(curve: PrecisionRecall, precision: float) -> OperatingPoint | None:
    """The lowest threshold at which the precision is at least ``precision``, 0 to 1, or ``None``.
    The precision may be less at a threshold above it."""
    _check_fraction("precision", precision)
    reached = np.flatnonzero(curve.precision >= precision)
    return _point(curve, int(reached[-1])) if len(reached) else None


def at_recall(curve: PrecisionRecall, recall: float) -> OperatingPoint | None:
    """The highest threshold at which the recall is at least ``recall``, 0 to 1, or ``None``."""
    _check_fraction("recall", recall)
    reached = np.flatnonzero(curve.recall >= recall)
    return _point(curve, int(reached[0])) if len(reached) else None


def suggested(curve: PrecisionRecall, precision: float = SURE_PRECISION) -> OperatingPoint | None:
    """A threshold for use: the lowest whose precision is surely at least ``precision``.

    Surely means the lower end of Wilson's 95 % interval: for a precision of 0.95, 73 queries must
    be accepted without a mistake. The threshold lies halfway to the next lower score, so that it
    accepts the same queries where a score must be above it, as in `ssrvlad_torch.match`; without a
    lower score it is the next lower float32.

    Where no threshold is that sure, it is the one with the highest lower end; `needed` says how
    many queries would prove more. The interval holds for one threshold chosen beforehand; the best
    of many is a little better than it will be on other queries.

    Returns:
        ``None`` only if no accepted query is right, or there is none.
    """
    _check_fraction("precision", precision)
    low = wilson_low(curve.true_positives, curve.accepted)
    if not low.max(initial=0.0):
        return None
    sure = np.flatnonzero(low >= min(precision, float(low.max())))
    last = int(sure[-1])
    return _point(curve, last)._replace(score=_below(curve, last))


def needed(precision: float = SURE_PRECISION) -> int:
    """How many queries, accepted without a mistake, prove a precision."""
    return math.ceil(_Z2 * precision / (1 - precision))


def operating_points(curve: PrecisionRecall, recalls: Sequence[float] = (0.5,)) -> dict[str, Any]:
    """The points at 99 % and 100 % precision and at given recalls, and the suggested one.

    Args:
        curve: of one set of queries, without a leading axis. By the convention ``exact`` it counts
            queries of unknown places as they will count in use.
        recalls: each 0 to 1.

    Returns:
        ``at_precision`` by ``"0.99"`` and ``"1"``, ``at_recall`` by the recall as text, and
        ``suggested``; each point as a mapping, or ``None``.
    """

    def mapping(point: OperatingPoint | None) -> dict[str, Any] | None:
        return point and point._asdict()

    return {
        "at_precision": {f"{p:g}": mapping(at_precision(curve, p)) for p in (0.99, 1.0)},
        "at_recall": {f"{r:g}": mapping(at_recall(curve, r)) for r in recalls},
        "suggested": mapping(suggested(curve)),
    }


def wilson_low(right: Floats, accepted: Floats) -> Floats:
    """Lower end of Wilson's interval of a fraction, `LEVEL` wide (Wilson, JASA 1927).

    Args:
        right, accepted: counts; the fraction is ``right / accepted``. 0 of 0 gives 0.
    """
    n = np.maximum(accepted, 1)
    fraction = right / n
    spread = np.sqrt(_Z2 * fraction * (1 - fraction) / n + (_Z2 / n / 2) ** 2)
    return np.maximum((fraction + _Z2 / n / 2 - spread) / (1 + _Z2 / n), 0.0)


def _point(curve: PrecisionRecall, place: int) -> OperatingPoint:
    return OperatingPoint(
        score=float(curve.thresholds[place]),
        precision=float(curve.precision[place]),
        precision_low=float(wilson_low(curve.true_positives, curve.accepted)[place]),
        recall=float(curve.recall[place]),
        accepted=int(curve.accepted[place]),
    )


def _below(curve: PrecisionRecall, place: int) -> float:
    """A score between the threshold at a place and the next lower one."""
    score = curve.thresholds[place]
    if place + 1 < len(curve.thresholds):
        return float(score + curve.thresholds[place + 1]) / 2
    return float(np.nextafter(np.float32(score), np.float32(-np.inf)))


def _check_fraction(name: str, fraction: float) -> None:
    if not 0 <= fraction <= 1:
        raise ValueError(f"expected a {name} from 0 to 1, got {fraction}")
