"""The page of ``ssrvlad evaluate --report``."""

from collections.abc import Sequence
from pathlib import Path

from ..config import package_version
from ..datasets.dataset import shortened
from ..evaluation.measure import Evaluation
from ..evaluation.report import render, write_report
from .words import lower_bound, steps_in_words, without_truth


def write_page(path: Path, evaluation: Evaluation, database: str, sources: Sequence[str]) -> None:
    """Writes the page of an evaluation, with the names of the database and of the sources of the
    queries."""
    metrics = evaluation.metrics
    names = shortened(["/".join(Path(source).parts[-2:]) or source for source in sources])
    settings = {
        "preset": metrics["preset"],
        "references": database,
        "queries": shortened(sources),
        "true matches": evaluation.true_matches,
        "fingerprint": metrics["fingerprint"],
        "steps": steps_in_words(metrics["steps"], metrics["temporal"]),
        "score is": metrics["score_is"],
        "ssrvlad-torch": package_version(),
    }
    suggested = lower_bound(metrics["thresholds"]["suggested"])
    notes = [*_notes(evaluation), suggested, *without_truth(metrics)]
    title = f"{names} against {Path(database).name or database}"
    write_report(path, render(evaluation, title, settings, notes))


def _notes(evaluation: Evaluation) -> list[str]:
    """The numbers of queries that were left out or skipped, and the reasons."""
    unknown, skipped = evaluation.left_out, evaluation.recognition.skipped
    notes = []
    if unknown:
        count = len(evaluation.truth) + unknown
        notes.append(f"{unknown} of {count} queries are left out: no true matches are known")
    if skipped:
        first = f"{skipped[0].frame}: {skipped[0].reason}"
        notes.append(f"{len(skipped)} more queries were skipped, the first is {first}")
    return notes
