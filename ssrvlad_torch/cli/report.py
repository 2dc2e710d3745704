"""The page of ``ssrvlad evaluate --report``."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..config import package_version
from ..datasets.dataset import shortened
from ..evaluation.ground_truth_files import PartialTruth, known_matches
from ..evaluation.measure import Recognition
from ..evaluation.metrics import precision_recall_curve
from ..evaluation.outcomes import judge
from ..evaluation.report import Report, write_report
from ..map import Evaluation
from .words import lower_bound, steps_in_words, without_truth


def write_page(path: Path, evaluation: Evaluation, database: str, sources: Sequence[str]) -> None:
    """Writes the page of the queries whose true matches are known, with the names of the database
    and of the sources of the queries."""
    metrics, recognition = evaluation.metrics, evaluation.recognition
    known, true_rows = known_matches(evaluation.truth)
    scores, rows = (column.numpy()[known] for column in recognition.matches)
    outcomes = judge(scores, rows, true_rows)
    pairs = None if recognition.similarity is None else recognition.similarity[known]
    assert recognition.material
    names = shortened(["/".join(Path(source).parts[-2:]) or source for source in sources])
    report = Report(
        title=f"{names} against {Path(database).name or database}",
        metrics=metrics,
        queries=replace(
            recognition.queries,
            frames=tuple(recognition.queries.frames[row] for row in known),
            poses=recognition.queries.poses[known],
        ),
        references=recognition.references,
        outcomes=outcomes,
        truth=true_rows,
        curve=precision_recall_curve(outcomes, true_rows, metrics["convention"], pairs),
        material=recognition.material.part(np.array(known, np.int64)),
        score=metrics["score_is"] or "score",
        settings=_settings(recognition.details, database, sources, evaluation.true_matches),
        notes=[
            *_notes(recognition, evaluation.truth),
            lower_bound(metrics["thresholds"]["suggested"]),
            *without_truth(metrics),
        ],
    )
    write_report(path, report)


def _settings(
    details: Mapping[str, Any], database: str, sources: Sequence[str], true_matches: str
) -> dict[str, str]:
    """The settings of the page, and the details of the recognition, in words."""
    words = {
        "preset": details["preset"],
        "references": database,
        "queries": shortened(sources),
        "true matches": true_matches,
        **details,
        "steps": steps_in_words(details["steps"], details["temporal"]),
        "ssrvlad-torch": package_version(),
    }
    del words["temporal"]
    return {
        name.replace("_", " "): f"{value:.3f}" if isinstance(value, float) else str(value)
        for name, value in words.items()
    }


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
