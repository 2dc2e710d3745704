"""The page of ``ssrvlad evaluate --report``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import __version__
from ..datasets.dataset import shortened
from ..evaluation.ground_truth_files import PartialTruth, known_matches
from ..evaluation.metrics import precision_recall_curve
from ..evaluation.outcomes import judge
from ..evaluation.report import Report, cosine_scores, stored_scores, write_report
from ..files import check_output
from .measure import Recognition, steps_in_words
from .pictures import require_files
from .truth import Places, TrueMatches

CANDIDATES = 100
"""Largest N of the curve of RecallRate@N."""


@dataclass(frozen=True)
class Page:
    """The page to write.

    Attributes:
        path: the file.
        pictures: folders of label maps or images of the references.

    Raises:
        ValueError: the file cannot be written, or the folders hold no pictures.
    """

    path: Path
    pictures: Sequence[str]

    def __post_init__(self) -> None:
        check_output(self.path)
        require_files(self.pictures)

    def write(
        self,
        recognition: Recognition,
        truth: PartialTruth,
        metrics: Mapping[str, Any],
        title: str,
        settings: Mapping[str, object],
    ) -> None:
        """Writes the page of the queries whose true matches are known.

        Args:
            recognition: the candidates of the queries.
            truth: true matches of each query.
            metrics: from `measure`.
            title: of the page.
            settings: names and values to show, besides the details of the recognition.
        """
        known, true_rows = known_matches(truth)
        scores, rows = (part.numpy()[known, :CANDIDATES] for part in recognition.matches)
        outcomes = judge(scores, rows, true_rows)
        pairs = None if recognition.similarity is None else recognition.similarity[known]
        names = ("query_pictures", "reference_pictures")
        pictures: dict[str, Any] = dict(zip(names, recognition.pictures or (), strict=False))
        report = Report(
            title=title,
            metrics=metrics,
            queries=_selected(recognition.queries, known),
            references=recognition.references,
            outcomes=outcomes,
            truth=true_rows,
            candidates=min(scores.shape[1], len(recognition.references.frames)),
            curve=precision_recall_curve(outcomes, true_rows, metrics["convention"], pairs),
            settings=_settings(settings, recognition),
            notes=_notes(recognition, truth),
            **_scores(recognition, known, pairs),
            **pictures,
        )
        write_report(self.path, report)


def title_and_settings(
    references: Path, queries: Sequence[str], truth: TrueMatches
) -> tuple[str, dict[str, str]]:
    """The title of a page, and its settings: the references, the queries and the ground truth."""
    names = shortened(["/".join(Path(place).parts[-2:]) or place for place in queries])
    title = f"{names} against {references.name or references}"
    return title, {
        "references": str(references),
        "queries": shortened(queries),
        "true matches": truth.words,
    }


def _selected(places: Places, rows: Sequence[int]) -> Places:
    frames = tuple(places.frames[row] for row in rows)
    return replace(places, frames=frames, poses=places.poses[rows])


def _scores(
    recognition: Recognition, known: list[int], pairs: npt.NDArray[np.float32] | None
) -> dict[str, Any]:
    """Scores of all pairs of the known queries, and the descriptors if they are known."""
    if recognition.descriptors is None:
        assert pairs is not None
        return {"scores": stored_scores(pairs)}
    queries, references = recognition.descriptors.queries[known], recognition.descriptors.references
    return {
        "scores": cosine_scores(queries, references),
        "descriptors": recognition.descriptors._replace(queries=queries),
    }


def _settings(settings: Mapping[str, object], recognition: Recognition) -> dict[str, str]:
    """The method first, then the settings and the details of the recognition, in words."""
    details = dict(recognition.details)
    method = {"method": f"SSR-VLAD {details.pop('preset')}"} if "preset" in details else {}
    if details.get("steps"):
        details["steps"] = steps_in_words(details["steps"], details.pop("temporal", None))
    return _in_words({**method, **settings, **details, "ssrvlad-torch": __version__})


def _in_words(settings: Mapping[str, object]) -> dict[str, str]:
    return {name.replace("_", " "): _words(value) for name, value in settings.items()}


def _words(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {words}" for name, words in _in_words(value).items())
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _notes(recognition: Recognition, truth: PartialTruth) -> list[str]:
    """The numbers of queries that were left out or skipped, and the reasons."""
    unknown, skipped = sum(rows is None for rows in truth), recognition.skipped
    notes = []
    if unknown:
        notes.append(f"{unknown} of {len(truth)} queries are left out: no true matches are known")
    if skipped:
        first = f"{skipped[0].frame}: {skipped[0].reason}"
        notes.append(f"{len(skipped)} more queries were skipped, the first is {first}")
    return notes
