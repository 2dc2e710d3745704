"""Precision and recall of loop closures in one stream, by the poses of its frames."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .curves import PrecisionRecall
from .outcomes import Bools, Floats, Rows
from .thresholds import OperatingPoint, suggested, wilson_low

FACING = math.radians(45)
"""Frames whose headings differ by less look the same way."""

EVEN = 0.5
"""A loop of less probability is more probably wrong than right."""


class LoopScore(NamedTuple):
    """Counts of frames.

    Attributes:
        accepted: frames that close a loop.
        right: those of them whose candidate is near.
        revisits: frames at whose place another frame looked the same way before.
        recognised: those of them that close a loop with a candidate that is near.
    """

    accepted: int
    right: int
    revisits: int
    recognised: int

    @property
    def precision(self) -> float:
        """Right / accepted; NaN if no loop was accepted."""
        return self.right / self.accepted if self.accepted else math.nan

    @property
    def recall(self) -> float:
        """Recognised / revisits; NaN without a revisit."""
        return self.recognised / self.revisits if self.revisits else math.nan


def score_loops(
    candidates: Rows, poses: Floats, exclude: int, metres: float, first: int = 0
) -> LoopScore:
    """Compares the loops of a stream with the poses of its frames.

    A loop is right if its two frames are near each other, whatever their headings. A frame is a
    revisit if an earlier one, too long ago to be excluded, is near and looks the same way; an
    unknown heading looks every way. Frames without a position are left out.

    Args:
        candidates: ``(N,)`` int64, row of the candidate of each frame that closes a loop, else -1.
        poses: ``(N, 3)`` x and y in metres and heading in radians, NaN where unknown.
        exclude: so many frames before a frame are too recent.
        metres: frames are near at this distance or less.
        first: row of the first frame that is counted.

    Raises:
        ValueError: the distance is negative, or no frame has a position.
    """
    if not metres >= 0:
        raise ValueError(f"the tolerance must be 0 metres or more, got {metres}")
    if np.isnan(poses[:, :2]).any(axis=1).all():
        raise ValueError(
            f"none of {len(poses)} frames has a pose; a tolerance in metres wants a poses.csv "
            "(frame,x,y,heading) in or beside their folder"
        )
    counts = np.zeros(4, np.int64)
    for row in range(first, len(poses)):
        if np.isnan(poses[row, :2]).any():
            continue
        x, y, turn = (poses[: max(0, row - exclude)] - poses[row]).T
        facing = np.isnan(turn) | (np.cos(turn) > math.cos(FACING))
        candidate = candidates[row]
        accepted = candidate >= 0 and not np.isnan(poses[candidate, :2]).any()
        right = accepted and math.dist(poses[row, :2], poses[candidate, :2]) <= metres
        revisit = bool(((np.hypot(x, y) <= metres) & facing).any())
        counts += (accepted, right, revisit, right and revisit)
    return LoopScore(*counts.tolist())


def loop_errors(candidates: Rows, poses: Floats) -> Floats:
    """``(L,)`` metres between each frame that closes a loop and its candidate, in the order of the
    frames; NaN where a position is unknown. Arguments as for `score_loops`."""
    here = np.flatnonzero(candidates >= 0)
    east, north, _ = (poses[here] - poses[candidates[here]]).T
    apart: Floats = np.hypot(east, north)
    return apart


def loop_curve(strengths: Floats, right: Bools, revisits: int) -> PrecisionRecall:
    """Precision and recall over thresholds, of the loops that a detector with a low threshold
    found.

    With a higher threshold it would find nearly those of them that are as strong: a loop that it
    does not believe may also change what it believes of later frames.

    Args:
        strengths: ``(L,)`` probabilities, see `LoopResult`.
        right: ``(L,)``, whether each is right.
        revisits: frames that could be recognised.
    """
    thresholds, places = np.unique(-strengths, return_inverse=True)
    return PrecisionRecall(
        accepted=np.cumsum(np.bincount(places, minlength=len(thresholds))).astype(np.float64),
        true_positives=np.cumsum(np.bincount(places, right, len(thresholds))),
        positives=np.array(float(revisits)),
        thresholds=-thresholds,
    )


def surest(curve: PrecisionRecall) -> OperatingPoint | None:
    """The threshold of `thresholds.suggested` for the highest precision that can be proven;
    ``None`` if no loop is right.

    It is at least `EVEN` where a right loop is as strong: a drive without a mistake does not prove
    that weaker loops are right on the next.
    """
    likely = int((curve.thresholds >= EVEN).sum())
    if likely and curve.true_positives[likely - 1]:
        curve = PrecisionRecall(
            curve.accepted[:likely],
            curve.true_positives[:likely],
            curve.positives,
            curve.thresholds[:likely],
        )
    sure = wilson_low(curve.true_positives, curve.accepted).max(initial=0.0)
    return suggested(curve, float(sure)) if sure else None
