"""``ssrvlad evaluate``."""

from __future__ import annotations

from pathlib import Path

from ..options import (
    AsOf,
    Json,
    RecognitionOptions,
    SourceOptions,
    TruthOptions,
    argument,
    option,
)
from ..output import finish, print_json, say


def evaluate(
    *,
    database: Path = argument("Folder of the database."),
    source: SourceOptions,
    recognition: RecognitionOptions,
    truth: TruthOptions,
    at_recall: float = option("Recall at which to print the precision.", default=0.5, min=0, max=1),
    as_of: AsOf = None,
    as_json: Json = False,
    report: Path | None = option(
        "Page to write (.html): metrics, curves, the similarity matrix, and matches with their "
        "pictures."
    ),
) -> None:
    """Measure place recognition: RecallRate@N, AUC-PR, Recall@100%Precision and more, with 95 %
    bootstrap intervals. A table shows precision and recall at several thresholds. The suggested
    threshold is the lowest whose precision has a 95 % interval that begins at 0.95 or higher; if
    there is none, the one whose interval begins highest.
    ssrvlad compare measures other methods.

    Example: ssrvlad evaluate town.ssrdb maps/today --tolerance-metres 5
    """
    from ...database.database import Database
    from ...files import check_output
    from ..measure import measure, print_metrics
    from ..recognise import by_database
    from ..report import title_and_settings, write_page
    from ..sources import Source
    from ..truth import TrueMatches

    if report:
        check_output(report)
    stored = Database.open(database, as_of)
    opened = Source.open(source, stored.folders()).with_network_of(stored)
    true = TrueMatches.of(truth, opened.dataset.truth if opened.dataset else None)
    opened = opened.posed() if true.metres is not None else opened
    found = by_database(stored, opened, recognition, truth.convention)
    known = true.among(found.references, found.queries)
    metrics = measure(found, known, truth.convention, at_recall)
    if as_json:
        print_json(metrics)
    else:
        print_metrics(metrics)
    if report:
        title, settings = title_and_settings(database, source.paths, true)
        write_page(report, found, known, metrics, title, settings)
        if not as_json:
            say(f"report: {report}")
    finish(found.skipped, len(found.queries.frames))
