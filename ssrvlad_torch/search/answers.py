"""Answers: the candidates of the frames of a source in a map, and how many of them are wrong."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from ..database.frames import FrameSet
from ..datasets.frame_file import Skipped
from ..datasets.poses import Pose
from ..evaluation.ground_truth_files import PartialTruth, known_matches
from ..evaluation.thresholds import SURE_PRECISION
from ..recognition.matching import Matches, candidates_table
from ..recognition.recognise import Confidence, Recognised


class Candidate(NamedTuple):
    """A frame of the map, its score for a query, and its pose: in metres and radians, NaN where
    unknown."""

    frame: str
    score: float
    pose: Pose


class Answer(NamedTuple):
    """The answer to one query.

    Attributes:
        query: id of the frame.
        candidates: best first; none if the query is empty or not accepted.
        score_is: ``"cosine"``, ``"fused score"`` or ``"probability"``, see `Recognised`.
        confidence: probability that the first candidate is right, 0 to 1.
        stamp: the time that was given with the frame.
        settled: online, whether 30 frames came before, whose mean stands for that of the sequence.
    """

    query: str
    candidates: list[Candidate]
    score_is: str
    confidence: float
    stamp: float | None = None
    settled: bool = True

    def as_json(self) -> dict[str, Any]:
        """A dict of JSON values, with ``poses`` of the candidates: what ``ssrvlad query --json``
        prints. An unknown number is ``None``."""
        ranked = [{"frame": frame, "score": score} for frame, score, _ in self.candidates]
        poses = [
            {axis: None if math.isnan(number) else number for axis, number in pose.items()}
            for pose in (candidate.pose._asdict() for candidate in self.candidates)
        ]
        line = {"query": self.query, "candidates": ranked, "score_is": self.score_is}
        return {**line, "confidence": self.confidence, "settled": self.settled, "poses": poses}


def candidates_of(
    references: FrameSet, scores: Iterable[float], rows: Iterable[int]
) -> list[Candidate]:
    """The frames of a map at rows, -1 for none. Scores that are rounded above 1 are 1."""
    return [
        Candidate(
            references.frames[row], min(1.0, float(score)), Pose(*references.poses[row].tolist())
        )
        for row, score in zip(rows, scores, strict=True)
        if row >= 0
    ]


class Estimate(NamedTuple):
    """How many of the accepted answers are wrong, without ground truth.

    Attributes:
        confidence: the least of an accepted answer; infinite if none is accepted.
        accepted: number of answers.
        wrong: estimated fraction of them that is wrong, 0 to 1, the mean of their doubts; 0 if none
            is accepted, 1 where the map has too few references to say.
        low, high: ends of its 95 % interval; ``None`` where it would say nothing.
    """

    confidence: float
    accepted: int
    wrong: float
    low: float | None
    high: float | None


def check_limits(min_confidence: float, max_wrong: float | None) -> None:
    """Requires limits of `Answers.accepted`, each from 0 to 1, not both; else a ValueError."""
    for name, limit in (("min_confidence", min_confidence), ("max_wrong", max_wrong)):
        if limit is not None and not 0 <= limit <= 1:
            raise ValueError(f"{name}: expected a fraction from 0 to 1, got {limit}")
    if min_confidence and max_wrong is not None:
        raise ValueError("max_wrong chooses the least confidence; expected no min_confidence")


@dataclass(repr=False, eq=False)
class Answers:
    """The answers to all frames of a source; iterating gives an `Answer` for each.

    Attributes:
        queries, references: the frames of the source and of the map.
        recognised: all candidates, also those that are not accepted, and the steps as taken.
        temporal: t of Eq. 3.
        skipped: frames that could not be encoded.
        min_confidence, max_wrong: which queries are accepted, see `accepted`; by default all.
        matches: the candidates of the accepted queries. Scores that are rounded above 1 are 1.
        estimate: how many of these are wrong, without ground truth.
    """

    queries: FrameSet
    references: FrameSet
    recognised: Recognised
    temporal: int = 0
    skipped: tuple[Skipped, ...] = ()
    min_confidence: float = 0.0
    max_wrong: float | None = None
    matches: Matches = field(init=False)
    estimate: Estimate = field(init=False)

    def __post_init__(self) -> None:
        sure, least = self.recognised.sure, self.min_confidence
        check_limits(least, self.max_wrong)
        if self.max_wrong is None:
            self.estimate = estimate(sure, least)
        else:
            self.estimate = accept(sure, self.max_wrong)
            least = self.estimate.confidence
        unsure, (scores, indices) = (sure.right < least)[:, None], self.recognised.matches
        scores = scores.clamp(max=1).masked_fill(unsure, -torch.inf)
        self.matches = Matches(scores, indices.masked_fill(unsure, -1))

    def __len__(self) -> int:
        return len(self.queries.frames)

    def __iter__(self) -> Iterator[Answer]:
        of = self.recognised
        numbers = map(Tensor.tolist, (*self.matches, of.sure.right, of.settled))
        queries = zip(self.queries.frames, of.score_is, *numbers, strict=True)
        for query, kind, scores, rows, sure, settled in queries:
            candidates = candidates_of(self.references, scores, rows)
            yield Answer(query, candidates, kind, sure, settled=settled)

    def __repr__(self) -> str:
        return f"<Answers: {len(self)} queries, {self.estimate.accepted} accepted>"

    def _repr_html_(self) -> str:
        return candidates_table(*self.matches, confidence=self.recognised.confidence)

    def accepted(self, min_confidence: float = 0.0, max_wrong: float | None = None) -> Answers:
        """The answers with a confidence of at least ``min_confidence``, or, if ``max_wrong`` is
        given, as many as this fraction of wrong answers permits; the others have no candidate.
        Both, and a number outside 0 to 1, are a ValueError."""
        return replace(self, min_confidence=min_confidence, max_wrong=max_wrong)

    def judged(self, truth: PartialTruth) -> dict[str, Any]:
        """What is expected without ground truth, beside the true matches of each query, ready for
        JSON: the mean confidence, and how many answers are wrong of the accepted ones, and of those
        that have a precision of `SURE_PRECISION`."""
        judged, true_rows = known_matches(truth)
        sure = self.recognised.confidence.numpy()[judged]
        there = answered(self.recognised.sure).numpy()[judged]
        answers = self.recognised.matches.indices[:, 0].numpy()[judged]
        right = np.array([row in true for row, true in zip(answers, true_rows, strict=True)], bool)
        suggested = accept(self.recognised.sure, 1 - SURE_PRECISION)
        expected = {"accepted": self.estimate, "suggested_without_truth": suggested}
        estimates = {
            name: {
                **estimate_in_json(wrong),
                "of_known_truth": int(accepted.sum()),
                "truly_wrong": float(1 - right[accepted].mean()) if accepted.any() else None,
            }
            for name, wrong in expected.items()
            for accepted in [(sure >= wrong.confidence) & there]
        }
        return {"mean_confidence": float(sure.mean()), "estimates": estimates}


def estimate_in_json(wrong: Estimate) -> dict[str, Any]:
    """The estimate as a mapping; its confidence is ``None`` where no answer is accepted."""
    return {**wrong._asdict(), "confidence": wrong.confidence if wrong.accepted else None}


_NOTHING = 0.9
"""An interval of this width says nothing."""


def estimate(sure: Confidence, least: float = 0.0) -> Estimate:
    """The estimate for answers with a confidence of at least ``least``. The fraction of wrong ones
    is given the beta distribution whose variance comes from chance, counted in clusters of answers
    that err together, and from what the sequence does not show."""
    accepted = answered(sure) & (sure.right >= least)
    count = int(accepted.sum())
    if not count:
        return Estimate(torch.inf, 0, 0.0, 0.0, 0.0)
    if not sure.right.any():
        return Estimate(float(least), count, 1.0, None, None)
    doubts = 1 - sure.right[accepted].double()
    wrong = float(doubts.mean())
    by_chance = doubts * (1 - doubts) * sure.together[accepted] / count
    ends = _beta(wrong, float(sure.spread[accepted].mean()) ** 2 + float(by_chance.mean()))
    low, high = math.floor(ends[0] * count) / count, math.ceil(ends[1] * count) / count
    interval = (low, high) if high - low <= _NOTHING else (None, None)
    return Estimate(float(least), count, wrong, *interval)


def accept(sure: Confidence, max_wrong: float) -> Estimate:
    """The estimate that accepts most answers while it is at most ``max_wrong``, 0 to 1; none if an
    interval would say nothing."""
    order = sure.right[answered(sure)].double().sort(descending=True).values
    permitted = (1 - order).cumsum(0) <= max_wrong * torch.arange(1, len(order) + 1)
    last = torch.ones_like(permitted)
    last[:-1] = order[1:] < order[:-1]
    chosen = (permitted & last).nonzero()[:, 0]
    most = estimate(sure, float(order[chosen[-1]]) if len(chosen) else torch.inf)
    return estimate(sure, torch.inf) if most.low is None else most


def answered(sure: Confidence) -> Tensor:
    """``(Q,)`` bool, whether a query has a candidate."""
    return sure.together > 0


def _beta(mean: float, variance: float) -> tuple[float, float]:
    """The quantiles 0.025 and 0.975 of the beta distribution with a mean and a variance; beyond
    logits of `_FAR` they are 0 and 1."""
    mean = min(max(mean, _TINY), 1 - _TINY)
    size = max(mean * (1 - mean) / max(variance, _TINY**2) - 1, _TINY)
    logits = torch.linspace(-_FAR, _FAR, 601, dtype=torch.double)
    log = mean * size * logsigmoid(logits) + (1 - mean) * size * logsigmoid(-logits)
    scale = float(log.max())
    inside = (log - scale).exp().cumsum(0) * float(logits[1] - logits[0])
    before, after = (
        math.exp(-_FAR * size * share - scale) / (size * share) for share in (mean, 1 - mean)
    )
    below = (before + inside) / (before + float(inside[-1]) + after)
    ends = torch.cat((torch.zeros(1), torch.sigmoid(logits[1:]), torch.ones(1)))
    quantiles = torch.tensor([0.025, 0.975], dtype=torch.double)
    low, high = ends[torch.searchsorted(below, quantiles)].tolist()
    return low, high


_TINY, _FAR = 1e-6, 15.0
