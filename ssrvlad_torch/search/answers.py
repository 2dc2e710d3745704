"""Answers: the candidates of the frames of a source in a map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from ..database.frames import FrameSet
from ..datasets.frame_file import Skipped
from ..datasets.names import SequenceFolders
from ..datasets.poses import Pose
from ..evaluation.ground_truth_files import PartialTruth, known_matches
from ..evaluation.thresholds import SURE_PRECISION
from ..recognition.confidence import Estimate, accept, answered, estimate
from ..recognition.matching import Matches, candidates_table
from ..recognition.recognise import Recognised


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


@dataclass(frozen=True, repr=False)
class Answers:
    """The answers to all frames of a source; iterating gives an `Answer` for each.

    Attributes:
        queries, references: the frames of the source and of the map.
        recognised: all candidates, also those that are not accepted, and the steps as taken.
        temporal: t of Eq. 3.
        skipped: frames that could not be encoded.
        folders: of the sequences of the queries.
        min_confidence, max_wrong: which queries are accepted, see `accepted`; by default all.
        matches: the candidates of the accepted queries. Scores that are rounded above 1 are 1.
        estimate: how many of these are wrong, without ground truth.
    """

    queries: FrameSet
    references: FrameSet
    recognised: Recognised
    temporal: int = 0
    skipped: tuple[Skipped, ...] = ()
    folders: SequenceFolders = ()
    min_confidence: float = 0.0
    max_wrong: float | None = None
    matches: Matches = field(init=False)
    estimate: Estimate = field(init=False)

    def __post_init__(self) -> None:
        sure, least = self.recognised.sure, self.min_confidence
        if self.max_wrong is None:
            wrong = estimate(sure, least)
        else:
            wrong = accept(sure, self.max_wrong)
            least = wrong.confidence
        unsure = self.recognised.confidence < least
        scores, indices = self.recognised.matches
        scores = scores.clamp(max=1).masked_fill(unsure[:, None], -torch.inf)
        matches = Matches(scores, indices.masked_fill(unsure[:, None], -1))
        vars(self).update(matches=matches, estimate=wrong)

    def __len__(self) -> int:
        return len(self.queries)

    def __iter__(self) -> Iterator[Answer]:
        sure = self.recognised.confidence.tolist()
        for number, query in enumerate(self.queries.frames):
            scores, rows = (column[number].tolist() for column in self.matches)
            candidates = candidates_of(self.references, scores, rows)
            kind, settled = self.recognised.score_is(number), bool(self.recognised.settled[number])
            yield Answer(query, candidates, kind, sure[number], settled=settled)

    def __repr__(self) -> str:
        return f"<Answers: {len(self)} queries, {self.estimate.accepted} accepted>"

    def _repr_html_(self) -> str:
        return candidates_table(*self.matches, confidence=self.recognised.confidence)

    def accepted(self, min_confidence: float = 0.0, max_wrong: float | None = None) -> Answers:
        """The answers with a confidence of at least ``min_confidence``, or, if ``max_wrong`` is
        given, as many as this fraction of wrong answers permits; the others have no candidate."""
        if max_wrong is not None and min_confidence:
            raise ValueError("max_wrong chooses the least confidence; expected no min_confidence")
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
