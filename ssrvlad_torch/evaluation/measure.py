"""Metrics of the candidates of queries."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..datasets.frame_file import Skipped
from ..recognition.confidence import Estimate, answered
from ..recognition.matching import Matches
from ..recognition.recognise import Recognised
from .ground_truth_files import PartialTruth, known_matches
from .metrics import Convention, evaluate, precision_recall_curve
from .outcomes import judge
from .report import Material
from .thresholds import operating_points
from .true_matches import Viewpoints

TOP = 10
"""Candidates of each query that the metrics need."""

RESAMPLES = 1000


@dataclass(frozen=True)
class Recognition:
    """The candidates of queries, and how they were found.

    Attributes:
        matches: candidates of each query, at least `TOP`.
        similarity: ``(Q, R)`` scores of all pairs, if they are needed.
        material: what the report shows of the frames.
        skipped: queries that could not be encoded.
        recognised: all candidates and how sure they are, if they are from a database.
        estimates: how many of some of them are wrong, without ground truth, by names.
        details: the method, its steps and its costs, for the report.
    """

    references: Viewpoints
    queries: Viewpoints
    matches: Matches
    similarity: npt.NDArray[np.float32] | None = None
    material: Material | None = None
    skipped: Sequence[Skipped] = ()
    recognised: Recognised | None = None
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)


def needs_similarity(convention: Convention) -> bool:
    """Whether a convention needs the scores of all pairs."""
    return convention.startswith("vpr-tutorial")


def measure(
    recognition: Recognition, truth: PartialTruth, convention: Convention
) -> dict[str, Any]:
    """All metrics with 95 % intervals, thresholds to choose from, and the details of the
    recognition. Queries whose true matches are not known are left out."""
    known, true_rows = known_matches(truth)
    scores, rows = (column.numpy()[known] for column in recognition.matches)
    pairs = recognition.similarity
    similarity = None if pairs is None else pairs[known]
    metrics = evaluate(
        scores, rows, true_rows, convention=convention, similarity=similarity, resamples=RESAMPLES
    )
    curve = precision_recall_curve(judge(scores, rows, true_rows), true_rows)
    metrics["thresholds"] = operating_points(curve)
    metrics["references"] = len(recognition.references.frames)
    if recognition.recognised:
        sure = recognition.recognised.confidence.numpy()[known]
        there = answered(recognition.recognised.sure).numpy()[known]
        answers = recognition.recognised.matches.indices[:, 0].numpy()[known]
        right = np.array([row in true for row, true in zip(answers, true_rows, strict=True)], bool)
        metrics["mean_confidence"] = float(sure.mean())
        metrics["estimates"] = {
            name: {
                **estimate_in_json(estimate),
                "of_known_truth": int(accepted.sum()),
                "truly_wrong": float(1 - right[accepted].mean()) if accepted.any() else None,
            }
            for name, estimate in recognition.estimates.items()
            for accepted in [(sure >= estimate.confidence) & there]
        }
    return {**metrics, **recognition.details}


def estimate_in_json(estimate: Estimate) -> dict[str, Any]:
    """The estimate as a mapping; its confidence is ``None`` where no answer is accepted."""
    return {**estimate._asdict(), "confidence": estimate.confidence if estimate.accepted else None}
