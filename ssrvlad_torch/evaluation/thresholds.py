"""Statistics to choose the score from which on a candidate is believed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from .curves import PrecisionRecall
from .outcomes import Floats

SURE_PRECISION = 0.95
LEVEL = 0.95


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
    """The point with the largest recall at which the precision is at least so much.

    It is the lowest such threshold. The precision may be less at a threshold above it.

    Returns:
        ``None`` if the precision is never reached.

    Raises:
        ValueError: ``precision`` is not in 0 to 1.
    """
    _check_fraction("precision", precision)
    reached = np.flatnonzero(curve.precision >= precision)
    return _point(curve, int(reached[-1])) if len(reached) else None


def at_recall(curve: PrecisionRecall, recall: float) -> OperatingPoint | None:
    """The highest threshold at which the recall is at least so much; its precision is the
    precision at that recall.

    Returns:
        ``None`` if the recall is never reached, or there is nothing to be found.

    Raises:
        ValueError: ``recall`` is not in 0 to 1.
    """
    _check_fraction("recall", recall)
    reached = np.flatnonzero(curve.recall >= recall)
    return _point(curve, int(reached[0])) if len(reached) else None


def suggested(curve: PrecisionRecall, precision: float = SURE_PRECISION) -> OperatingPoint | None:
    """A threshold for use: the lowest at which the precision is surely at least so much.

    Surely means the lower end of Wilson's 95 % interval, so few queries that are all right do not
    suffice: for a precision of 0.95, 73 queries must be accepted without a mistake. The threshold
    lies halfway to the next lower score that was measured, where it accepts the same queries, also
    if "above" is asked instead of "at least", as `ssrvlad_torch.match` does. Where no lower score
    was measured it is the next lower float32.

    Where no threshold is that sure, it is the one whose precision is sure to be highest: the lower
    end of its interval says what the data can prove, `needed` how much more would prove the rest.

    The interval holds for one threshold chosen beforehand; the best of many is a little better
    than it will be on other queries.

    Returns:
        ``None`` only if no accepted query is right, or there is none.

    Raises:
        ValueError: ``precision`` is not in 0 to 1.
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
    z2 = NormalDist().inv_cdf((1 + LEVEL) / 2) ** 2
    return math.ceil(z2 * precision / (1 - precision))


def operating_points(curve: PrecisionRecall, recalls: Sequence[float] = (0.5,)) -> dict[str, Any]:
    """The points at 99 % and 100 % precision and at given recalls, and the suggested one.

    Args:
        curve: of one set of queries, without a leading axis, from
            `metrics.precision_recall_curve`. By the convention ``exact`` it counts the queries of
            unknown places as they will count in use.
        recalls: each 0 to 1.

    Returns:
        ``at_precision`` by ``"0.99"`` and ``"1"``, ``at_recall`` by the recall as text, and
        ``suggested``; each point as a mapping, or ``None`` where there is none.
    """
    return {
        "at_precision": {f"{p:g}": _mapping(at_precision(curve, p)) for p in (0.99, 1.0)},
        "at_recall": {f"{r:g}": _mapping(at_recall(curve, r)) for r in recalls},
        "suggested": _mapping(suggested(curve)),
    }


def wilson_low(right: Floats, accepted: Floats) -> Floats:
    """Lower end of Wilson's interval of a fraction, `LEVEL` wide (Wilson, JASA 1927).

    Args:
        right, accepted: counts; the fraction is ``right / accepted``. 0 of 0 gives 0.
    """
    z2 = NormalDist().inv_cdf((1 + LEVEL) / 2) ** 2
    n = np.maximum(accepted, 1)
    fraction = right / n
    spread = np.sqrt(z2 * fraction * (1 - fraction) / n + (z2 / n / 2) ** 2)
    return np.maximum((fraction + z2 / n / 2 - spread) / (1 + z2 / n), 0.0)


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


def _mapping(point: OperatingPoint | None) -> dict[str, Any] | None:
    return None if point is None else point._asdict()


def _check_fraction(name: str, fraction: float) -> None:
    if not 0 <= fraction <= 1:
        raise ValueError(f"expected a {name} from 0 to 1, got {fraction}")
