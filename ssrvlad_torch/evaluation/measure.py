"""Metrics of the candidates of queries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..datasets.frame_file import Skipped
from ..datasets.image_files import Pixels
from ..recognition.matching import Matches
from .curves import Floats, Outcomes, Rows, Truth, judge
from .ground_truth import Viewpoints
from .ground_truth_files import PartialTruth, known_matches
from .metrics import Convention, evaluate, precision_recall_curve
from .thresholds import operating_points

TOP = 10
"""Candidates of each query that the metrics need."""

RESAMPLES = 1000


class Material(Protocol):
    """What a report shows of queries and references; files are read only when it asks."""

    def of_queries(self, queries: Rows) -> Material:
        """The same of the queries of these rows."""

    def cosines(self, queries: Rows, references: Rows) -> npt.NDArray[np.floating[Any]]:
        """``(n, m)`` of n queries and m references, single frames, by their rows; -inf for pairs
        that cannot match."""

    def query(self, frame: str) -> Mapping[str, Pixels]:
        """The pictures ``(H, W, 3)`` RGB of a query, by what they are, such as ``photo``."""

    def reference(self, frame: str) -> Mapping[str, Pixels]:
        """The same of a reference."""


@dataclass(frozen=True)
class Recognition:
    """The candidates of queries, at least `TOP` of each: what the report shows, the ``confidence``
    ``(Q,)``, if known, the queries that were not encoded, and details, which join the metrics."""

    references: Viewpoints
    queries: Viewpoints
    matches: Matches
    material: Material | None = None
    confidence: Floats | None = None
    skipped: Sequence[Skipped] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    def of_queries(self, rows: Rows) -> Recognition:
        """The same of the queries of these rows."""
        frames = tuple(self.queries.frames[row] for row in rows)
        return replace(
            self,
            queries=replace(self.queries, frames=frames, poses=self.queries.poses[rows]),
            matches=Matches(*(column[rows] for column in self.matches)),
            material=self.material and self.material.of_queries(rows),
            confidence=None if self.confidence is None else self.confidence[rows],
        )


@dataclass(frozen=True)
class Evaluation:
    """Measured candidates of the queries whose true matches are known.

    Attributes:
        metrics: the result of `metrics.evaluate` with 95 % intervals, ``thresholds`` to choose from
            (`operating_points`), ``threshold_is``, of what they are: ``confidence`` or else the
            score, ``references``, and the details of the recognition; for JSON.
        truth: the rows of the references that are true matches of each.
        outcomes, ranked: what became of each; in the second with what a threshold is of as scores.
        left_out: number of other queries.
        true_matches: how they are defined, in words.
    """

    metrics: dict[str, Any]
    recognition: Recognition
    truth: Truth
    outcomes: Outcomes
    ranked: Outcomes
    left_out: int = 0
    true_matches: str = ""

    @property
    def material(self) -> Material:
        """What the report shows of the frames."""
        assert self.recognition.material
        return self.recognition.material


def measure(recognition: Recognition, truth: PartialTruth, convention: Convention) -> Evaluation:
    """Measures the queries whose true matches are known."""
    covered, true = known_matches(truth)
    judged = recognition.of_queries(np.array(covered, np.int64))
    scores, rows = (column.numpy() for column in judged.matches)
    metrics = evaluate(scores, rows, true, convention=convention, resamples=RESAMPLES)
    outcomes = judge(scores, rows, true)
    ranked = outcomes
    if judged.confidence is not None:
        sure = np.where(outcomes.candidate < 0, -np.inf, judged.confidence)
        ranked = replace(outcomes, score=sure.astype(np.float64))
    metrics["thresholds"] = operating_points(precision_recall_curve(ranked))
    metrics["references"] = len(judged.references.frames)
    metrics |= judged.details
    known = judged.confidence is not None
    metrics["threshold_is"] = "confidence" if known else metrics.get("score_is") or "score"
    return Evaluation(metrics, judged, true, outcomes, ranked, len(truth) - len(covered))
