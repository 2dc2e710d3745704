"""``ssrvlad evaluate``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from ..options import (
    AsOf,
    DatabaseFolder,
    Json,
    RecognitionOptions,
    SourceOptions,
    TruthOptions,
    option,
)
from ..output import finish, note, print_json, progress_bar, say

if TYPE_CHECKING:
    from ...database.database import Database
    from ...encoding.source import Source
    from ...evaluation.measure import Recognition
    from ...evaluation.metrics import Convention


def evaluate(
    *,
    database: DatabaseFolder,
    source: SourceOptions,
    recognition: RecognitionOptions,
    truth: TruthOptions,
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
    from ...evaluation.measure import measure
    from ...evaluation.true_matches import TrueMatches
    from ...files import check_output
    from ..report import write_page
    from ..sources import resolve
    from ..words import print_metrics

    if report:
        check_output(report)
    stored = Database.open(database, as_of)
    by_poses = None if truth.definition == (None,) * 4 else truth.tolerance_metres is not None
    opened = resolve(source, stored, compared=True, posed=by_poses)
    true = TrueMatches.of(*truth.definition, opened.truth)
    found = _recognised(stored, opened, recognition, truth.convention)
    known = true.among(found.references, found.queries, note)
    metrics = measure(found, known, truth.convention)
    if as_json:
        print_json(metrics)
    else:
        print_metrics(metrics)
    if report:
        write_page(report, found, known, metrics, database, source.paths, true.words)
        if not as_json:
            say(f"report: {report}")
    finish(found.skipped, len(found.queries.frames))


def _recognised(
    database: Database, source: Source, options: RecognitionOptions, convention: Convention
) -> Recognition:
    """The candidates of every query in a database. A convention that needs the scores of all pairs
    measures cosines, without any step."""
    from ...encoding.pictures import pictures_of_queries, pictures_of_references
    from ...encoding.search import accepted, search
    from ...evaluation.measure import TOP, Recognition, needs_similarity
    from ...evaluation.thresholds import SURE_PRECISION
    from ...evaluation.true_matches import Viewpoints
    from ...recognition.confidence import accept
    from ...recognition.recognise import AS_PAPER
    from ...recognition.sweep import COLUMNS, score
    from ..words import score_name

    pairs = needs_similarity(convention)
    steps = AS_PAPER if pairs else options.steps()
    extra = False if pairs else options.with_extra
    with progress_bar("encoding", len(source.files)) as bar:
        found = search(database, source, steps, TOP, options.reach, extra, progress=bar.advance)
    queries, references, recognised, t, skipped, folders = found
    if queries.descriptors.ndim == 3:
        middle = queries.descriptors[:, COLUMNS.index(0)].contiguous()
        queries = dataclasses.replace(queries, descriptors=middle)
    config, segmenter, dataset = database.config, source.segmenter, source.dataset
    matches, estimate = accepted(recognised, options.min_confidence, options.max_wrong)
    vectors = queries.descriptors, references.descriptors
    return Recognition(
        references=Viewpoints.of_set(references, dataset, source.known),
        queries=Viewpoints.of_set(queries, dataset, folders, [f.frame for f in skipped]),
        matches=matches,
        recognised=recognised,
        estimates={
            "accepted": estimate,
            "suggested_without_truth": accept(recognised.sure, 1 - SURE_PRECISION),
        },
        similarity=score(*vectors).numpy() if pairs else None,
        descriptors=vectors,
        pictures=(
            pictures_of_queries(source.files, dataset, source.labels_as, segmenter),
            pictures_of_references(database, dataset, segmenter),
        ),
        skipped=skipped,
        details={
            "preset": config.preset,
            "fingerprint": config.fingerprint,
            "temporal": t,
            "steps": recognised.used,
            "score_is": score_name(recognised.used),
        },
    )
