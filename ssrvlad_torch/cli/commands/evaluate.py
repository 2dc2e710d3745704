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
    database: Path = argument("Folder of the database; with --method, of the references."),
    source: SourceOptions,
    method: MethodOptions,
    recognition: RecognitionOptions,
    truth: TruthOptions,
    at_recall: float = option(0.5, "Recall at which to report the precision.", min=0, max=1),
    as_of: AsOf = None,
    as_json: Json = False,
    report: Path | None = option(
        None,
        "Page to write (.html): the figures, curves, the similarity matrix, and matches "
        "with their pictures.",
    ),
    pictures: list[str] | None = option(
        None,
        "With --report: folder of the references' label maps, to show them; repeatable. "
        "Without it, they are looked for in the data set and beside SOURCE.",
    ),
) -> None:
    """Measure the recognition: RecallRate@N, AUC-PR, Recall@100%Precision and more, with 95 %
    bootstrap intervals. A table shows what several thresholds do. The suggested threshold is the
    lowest whose precision is at least 0.95 at the lower end of its 95 % interval.

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
        raise ValueError("--pictures wants a --report of a database")
    page = None if report is None else Page(report, pictures or ())
    town = None if method.method else Database.open(database, as_of)
    opened = Source.open(source, town.folders() if town else ())
    true = TrueMatches.by(truth, opened.dataset.truth if opened.dataset else None)
    if town:
        opened = opened.posed() if true.metres is not None else opened
        found = by_database(town, opened, recognition, truth.convention, page)
    else:
        found = by_method(method, database, opened, recognition, truth.convention, page)
    matches = true.among(found.references, found.queries)
    metrics = measure(found, matches, truth.convention, at_recall)
    if as_json:
        print_json(metrics)
    else:
        print_metrics(metrics)
    if page:
        title, settings = title_and_settings(database, source.paths, true)
        page.write(found, matches, metrics, title, settings)
        if not as_json:
            say(f"report: {page.path}")
    finish(found.skipped, len(found.queries.frames))


def _check(method: MethodOptions, recognition: RecognitionOptions, source: SourceOptions) -> None:
    """Refuses options that do not go together, and names what to use instead."""
    if method.method is None:
        if method.settings or method.named:
            name = "set" if method.settings else next(iter(method.named)).replace("_", "-")
            raise ValueError(f"--{name} wants a --method")
        return
    if recognition.min_confidence:
        raise ValueError("--min-confidence is of a database: confidence is fitted to its scores")
    if recognition.fuse:
        raise ValueError("--fuse is of a database; ssrvlad compare --fuse takes methods together")
    if recognition.reach:
        raise ValueError(
            "--temporal and --as-paper are of a database; with --method ssr-vlad use "
            f"--set temporal={recognition.reach.frames or 't'}"
        )
    if source.segmenter is not None:
        raise ValueError(
            "--segmenter does not go with --method: encode a database with it and evaluate that, "
            "or give a method of label maps the folder of a network's label maps"
        )
    if source.layout is not None:
        raise ValueError(
            "--layout does not go with --method: use ssrvlad compare, or name the two folders"
        )
