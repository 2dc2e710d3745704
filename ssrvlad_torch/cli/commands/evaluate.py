"""``ssrvlad evaluate``."""

from __future__ import annotations

from pathlib import Path

from ..options import (
    AsOf,
    Json,
    MethodOptions,
    RecognitionOptions,
    SourceOptions,
    TruthOptions,
    argument,
    option,
)
from ..output import finish, print_json, say


def evaluate(
    *,
    database: Path = argument("Folder of the database, or of the references with --method."),
    source: SourceOptions,
    method: MethodOptions,
    recognition: RecognitionOptions,
    truth: TruthOptions,
    at_recall: float = option("Recall at which to print the precision.", default=0.5, min=0, max=1),
    as_of: AsOf = None,
    as_json: Json = False,
    report: Path | None = option(
        "Page to write (.html): metrics, curves, the similarity matrix, and matches with their "
        "pictures."
    ),
    pictures: list[str] | None = option(
        "With --report: folder of the references' label maps, to show them; can be repeated. "
        "Default: the data set and the folders beside SOURCE are searched."
    ),
) -> None:
    """Measure place recognition: RecallRate@N, AUC-PR, Recall@100%Precision and more, with 95 %
    bootstrap intervals. A table shows precision and recall at several thresholds. The suggested
    threshold is the lowest whose precision has a 95 % interval that begins at 0.95 or higher.

    With --method, another method is measured on the frames themselves.

    Example: ssrvlad evaluate town.ssrdb maps/today --tolerance-metres 5

    Example: ssrvlad evaluate photos/monday photos/today --method hog --tolerance-metres 5
    """
    from ...database.database import Database
    from ..measure import measure, print_metrics
    from ..recognise import by_database, by_method
    from ..report import Page, title_and_settings
    from ..sources import Source
    from ..truth import TrueMatches

    _check(method, recognition, source)
    if pictures and (report is None or method.method):
        raise ValueError("--pictures needs the --report of a database")
    page = None if report is None else Page(report, pictures or ())
    stored = None if method.method else Database.open(database, as_of)
    opened = Source.open(source, stored.folders() if stored else ())
    true = TrueMatches.of(truth, opened.dataset.truth if opened.dataset else None)
    if stored:
        opened = opened.posed() if true.metres is not None else opened
        found = by_database(stored, opened, recognition, truth.convention, page)
    else:
        found = by_method(method, database, opened, recognition, truth.convention, page)
    known = true.among(found.references, found.queries)
    metrics = measure(found, known, truth.convention, at_recall)
    if as_json:
        print_json(metrics)
    else:
        print_metrics(metrics)
    if page:
        title, settings = title_and_settings(database, source.paths, true)
        page.write(found, known, metrics, title, settings)
        if not as_json:
            say(f"report: {page.path}")
    finish(found.skipped, len(found.queries.frames))


def _check(method: MethodOptions, recognition: RecognitionOptions, source: SourceOptions) -> None:
    """Refuses options that do not go together."""
    if method.method is None:
        if method.settings or method.named:
            name = "set" if method.settings else next(iter(method.named)).replace("_", "-")
            raise ValueError(f"--{name} needs --method")
        return
    if recognition.min_confidence:
        raise ValueError("--min-confidence does not go with --method: it needs a database")
    if recognition.fuse:
        raise ValueError("--fuse does not go with --method: use ssrvlad compare --fuse")
    if recognition.reach:
        raise ValueError(
            "--temporal and --as-paper do not go with --method; for ssr-vlad use "
            f"--set temporal={recognition.reach.frames or 't'}"
        )
    if source.segmenter is not None:
        raise ValueError(
            "--segmenter does not go with --method: encode a database with it and evaluate that, "
            "or use a folder of label maps as SOURCE"
        )
    if source.layout is not None:
        raise ValueError(
            "--layout does not go with --method: use ssrvlad compare, or name the two folders"
        )
