"""Holds a frame of a stream against the earlier ones: the best candidate, and every check."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .config import LoopConfig
from .log import LoopLog
from .memory import Floats, Snapshot
from .result import LoopResult, Reason
from .sighting import GeometricCheck, PoseGate, Sighting

_LEAST_SPREAD = 1e-6
_ROUNDING = 1e-6
"""Cosines of 480 float32 products are no more exact than this."""


class Found(NamedTuple):
    """The best candidate of a frame, and what it is judged by.

    Attributes:
        here: the frame.
        candidate: row of the candidate.
        scores: ``(rows of the map,)`` float32, -inf for empty frames and where the pose gate is
            shut.
        own_strength: strength of the candidate.
        strength: what is held against the threshold.
        cutoff: the threshold as a cosine.
        moments: mean, and mean square, of the nearness of all candidates.
    """

    here: Sighting
    candidate: int
    scores: Floats
    own_strength: float
    strength: float
    cutoff: float
    moments: tuple[float, float]

    @property
    def score(self) -> float:
        """Cosine of the candidate."""
        return float(self.scores[self.candidate])


class LoopJudge:
    """Finds the best candidate of a frame and says which check it fails first, if any.

    It reads the log of the earlier frames and changes nothing.

    Args:
        config: the settings of the checks.
        log: of the frames so far; the one to be judged is not in it.
        pose_gate, geometry: as for `LoopDetector`.
    """

    def __init__(
        self,
        config: LoopConfig,
        log: LoopLog,
        pose_gate: PoseGate | None = None,
        geometry: GeometricCheck | None = None,
    ) -> None:
        self.config = config
        self._log = log
        self._pose_gate, self._geometry = pose_gate, geometry

    def judge(
        self, here: Sighting, descriptor: Floats, known: Snapshot
    ) -> tuple[LoopResult, Found | None]:
        """What becomes of the next frame, and its best candidate.

        Args:
            here: the frame.
            descriptor: ``(D,)`` float32, raw.
            known: the map of the frames so far.

        Raises:
            ValueError: the pose gate gave something else than a bool for each pose.
        """
        found = self._find(here, descriptor, known)
        if isinstance(found, Reason):
            return LoopResult(here.frame, found), None
        return self._result(found), found

    def _find(self, here: Sighting, descriptor: Floats, known: Snapshot) -> Found | Reason:
        """The best candidate, or why there is none."""
        if not descriptor.any():
            return Reason.EMPTY_FRAME
        if not len(self._log):
            return Reason.NO_CANDIDATE
        scores = known.scores(descriptor / np.linalg.norm(descriptor))
        old = self._old(here, len(scores))
        compared = scores[:old][~known.empty[:old]]
        if not len(compared):
            return Reason.NO_CANDIDATE if old else Reason.TOO_RECENT
        self._close_gate(here, scores)
        candidate = int(scores[:old].argmax())
        if scores[candidate] == -np.inf:
            return Reason.IMPLAUSIBLE
        return self._weigh(here, scores, candidate, _moments(_nearness(compared)))

    def _weigh(
        self, here: Sighting, scores: Floats, candidate: int, moments: tuple[float, float]
    ) -> Found:
        """The best candidate with its strength."""
        strength, cutoff = float(scores[candidate]), self.config.threshold
        if self.config.relative:
            mean, spread = self._spread(moments)
            strength = (float(_nearness(scores[candidate])) - mean) / spread
            cutoff = 1 - math.exp(-mean - self.config.threshold * spread)
        earlier = self._log.strengths(self.config.confirmations - 1)
        shared = float(np.nanmean(np.append(earlier, strength)))
        return Found(here, candidate, scores, strength, shared, cutoff, moments)

    def _old(self, here: Sighting, mapped: int) -> int:
        """How many rows of the map are not too recent to be candidates."""
        rows = min(mapped, len(self._log) - self.config.exclude)
        if self.config.exclude_seconds:
            latest = here.stamp - self.config.exclude_seconds
            rows = min(rows, int(np.searchsorted(self._log.stamps, latest, side="right")))
        return max(0, rows)

    def _close_gate(self, here: Sighting, scores: Floats) -> None:
        if self._pose_gate is None:
            return
        poses = self._log.poses[: len(scores)]
        poses.flags.writeable = False
        plausible = np.asarray(self._pose_gate(here.pose, poses))
        if plausible.shape != scores.shape or plausible.dtype != np.bool_:
            raise ValueError(
                f"the pose gate gave {plausible.shape} {plausible.dtype} for {len(scores)} poses; "
                "wanted a bool for each"
            )
        scores[~plausible] = -np.inf

    def _spread(self, moments: tuple[float, float]) -> tuple[float, float]:
        """Mean and standard deviation of the nearness of the candidates of the last frames."""
        earlier = self._log.moments(self.config.relative - 1)
        mean, square = np.nanmean(np.concatenate((earlier, [moments])), axis=0).tolist()
        return mean, math.sqrt(max(square - mean * mean, _LEAST_SPREAD**2))

    def _result(self, found: Found) -> LoopResult:
        checks: tuple[tuple[Reason, Callable[[Found], bool]], ...] = (
            (Reason.BELOW_THRESHOLD, lambda found: found.strength < self.config.threshold),
            (Reason.TOO_RECENT, lambda found: found.candidate >= self._present(found)),
            (Reason.AMBIGUOUS, self._has_rival),
            (Reason.INCONSISTENT, self._is_unconfirmed),
            (Reason.DISPROVED, self._is_disproved),
        )
        reason = next((reason for reason, holds in checks if holds(found)), Reason.ACCEPTED)
        candidate = self._log.frame(found.candidate)
        return LoopResult(found.here.frame, reason, candidate, found.score, found.strength)

    def _present(self, found: Found) -> int:
        """First row of the place that has not been left since."""
        cutoff = min(found.cutoff, found.score)
        alike = np.append(np.flatnonzero(found.scores >= cutoff), len(self._log))
        left = np.diff(alike) - 1 > self.config.neighbourhood + self.config.temporal
        return int(alike[np.flatnonzero(left)[-1] + 1 if left.any() else 0])

    def _has_rival(self, found: Found) -> bool:
        """Whether a frame that shows neither the candidate's place nor the present one is too near.

        A frame that closed a loop shows the place of its candidate, so that an earlier visit to
        the candidate's place is no rival.
        """
        if self.config.ratio == 1:
            return False
        others = found.scores.copy()
        reach = self.config.neighbourhood
        same = self._log.same_place(found.candidate, reach)
        others[same[same < len(others)]] = -np.inf
        others[max(0, self._present(found) - reach) :] = -np.inf
        return bool(1 - found.score > self.config.ratio**2 * (1 - others.max()))

    def _is_unconfirmed(self, found: Found) -> bool:
        """Whether the best candidates of the last frames do not stay together."""
        earlier = self.config.confirmations - 1
        if len(self._log) - earlier < self._log.start_of_sequence(found.here.frame):
            return True
        candidates = np.append(self._log.candidates(earlier), found.candidate)
        steps = np.abs(np.diff(candidates))
        return bool((candidates < 0).any() or (steps > self.config.window).any())

    def _is_disproved(self, found: Found) -> bool:
        if self._geometry is None:
            return False
        return not self._geometry(found.here, self._log.sighting(found.candidate))


def _nearness(scores: Floats | np.float32) -> Floats:
    """How near candidates are: less the logarithm of half their squared Euclidean distance."""
    return -np.log(np.maximum(1 - scores, np.float32(_ROUNDING)))


def _moments(values: Floats) -> tuple[float, float]:
    exact = values.astype(np.float64)
    return float(exact.mean()), float(exact @ exact) / len(exact)
