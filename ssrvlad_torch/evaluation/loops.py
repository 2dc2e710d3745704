"""Precision and recall of loop closures in one stream, by the poses of its frames."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .curves import Bools, Floats, PrecisionRecall, Rows, rank
from .ground_truth import check_distance, require_poses
from .thresholds import OperatingPoint, suggested_point, wilson_low

FACING = math.radians(45)
"""Frames look the same way if their headings differ by less, in radians."""

EVEN = 0.5
"""A loop with a lower probability is more likely wrong than right."""


class LoopScore(NamedTuple):
    """Counts of frames: those that close a loop, of them those that are right, and the revisits.
    Precision is right / accepted, recall right / revisits, NaN where that is 0 / 0."""

    accepted: int
    right: int
    revisits: int

    @property
    def precision(self) -> float:
        """Of the loops."""
        return self.right / self.accepted if self.accepted else math.nan

    @property
    def recall(self) -> float:
        """Of the revisits."""
        return self.right / self.revisits if self.revisits else math.nan


def score_loops(
    candidates: Rows,
    poses: Floats,
    exclude: int,
    metres: float,
    first: int = 0,
    sequences: Sequence[str] = (),
) -> LoopScore:
    """Compares the loops of a stream, ``candidates`` ``(N,)`` int64 rows or -1, from the row
    ``first`` on, with poses ``(N, 3)``, x and y in metres and heading in radians, NaN where
    unknown.

    A loop is right if its two frames are at most ``metres`` apart. A frame is a revisit if its loop
    is right, or an earlier frame, not among the last ``exclude`` of its sequence, is near and looks
    the same way. Frames without a position are left out; if all are, it is a ValueError."""
    check_distance(metres)
    posed = require_poses("frames", poses)
    counts, start = np.zeros(3, np.int64), 0
    for row in range(len(poses)):
        if row and sequences and sequences[row] != sequences[row - 1]:
            start = row
        if row < first or not posed[row]:
            continue
        x, y, turn = (poses[: max(start, row - exclude)] - poses[row]).T
        facing = np.isnan(turn) | (np.cos(turn) > math.cos(FACING))
        candidate = candidates[row]
        accepted = candidate >= 0 and posed[candidate]
        right = accepted and math.dist(poses[row, :2], poses[candidate, :2]) <= metres
        revisit = right or bool(((np.hypot(x, y) <= metres) & facing).any())
        counts += (accepted, right, revisit)
    return LoopScore(*counts.tolist())


def loop_errors(candidates: Rows, poses: Floats) -> Floats:
    """Distances ``(L,)`` in metres between the frames that close a loop and their candidates, in
    the order of the frames; NaN where a position is unknown. Arguments as for `score_loops`."""
    rows = np.flatnonzero(candidates >= 0)
    east, north, _ = (poses[rows] - poses[candidates[rows]]).T
    return np.asarray(np.hypot(east, north))


def loop_curve(probabilities: Floats, right: Bools, revisits: int) -> PrecisionRecall:
    """Approximate precision and recall over thresholds, by the probabilities ``(L,)`` of loops of a
    detector with a low threshold, which are right ``(L,)``, and the number of revisits."""
    return rank(probabilities, right).curve(np.ones(len(right)), np.array(float(revisits)))


def surest_point(curve: PrecisionRecall) -> OperatingPoint | None:
    """The threshold with the highest lower bound of the precision, see `suggested_point`, or
    ``None``. If a right loop has a probability of at least `EVEN`, less probable ones are not
    considered."""
    likely = int((curve.thresholds >= EVEN).sum())
    if likely and curve.true_positives[likely - 1]:
        counts = curve.accepted[:likely], curve.true_positives[:likely]
        curve = PrecisionRecall(*counts, curve.positives, curve.thresholds[:likely])
    precision = wilson_low(curve.true_positives, curve.accepted).max(initial=0.0)
    point = suggested_point(curve, float(precision)) if precision else None
    return point and point._replace(threshold=max(0.0, point.threshold))
