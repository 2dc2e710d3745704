"""The candidates that ``ssrvlad evaluate`` measures."""

from __future__ import annotations

import dataclasses

from ..database.database import Database
from ..evaluation.metrics import Convention
from ..evaluation.thresholds import SURE_PRECISION
from ..recognition.confidence import accept
from ..recognition.recognise import AS_PAPER
from ..recognition.sweep import COLUMNS, score
from .measure import TOP, Recognition, needs_similarity, score_name
from .options import RecognitionOptions
from .pictures import pictures_of_queries, pictures_of_references
from .search import accepted, search, settings_of
from .sources import Source
from .truth import Places


def by_database(
    database: Database, source: Source, options: RecognitionOptions, convention: Convention
) -> Recognition:
    """The candidates of every query in a database. A convention that needs the scores of all pairs
    measures cosines, without any step."""
    pairs = needs_similarity(convention)
    queries, references, recognised, t, skipped, folders = search(
        database, source, options, TOP, AS_PAPER if pairs else None
    )
    if queries.descriptors.ndim == 3:
        middle = queries.descriptors[:, COLUMNS.index(0)].contiguous()
        queries = dataclasses.replace(queries, descriptors=middle)
    config = settings_of(database, source.labels_as)
    matches, estimate = accepted(recognised, options)
    similarity = None
    if pairs:
        similarity = score(queries.descriptors, references.descriptors).numpy()
    return Recognition(
        references=Places.of_set(references, source.whole, source.known),
        queries=Places.of_set(queries, source.whole, folders, [f.frame for f in skipped]),
        matches=matches,
        recognised=recognised,
        estimates={
            "accepted": estimate,
            "suggested_without_truth": accept(recognised.sure, 1 - SURE_PRECISION),
        },
        similarity=similarity,
        descriptors=(queries.descriptors, references.descriptors),
        pictures=(
            pictures_of_queries(source, config.labels_as),
            pictures_of_references(database, source, config.labels_as),
        ),
        skipped=skipped,
        details={
            "preset": config.preset,
            "fingerprint": config.fingerprint,
            "temporal": t,
            "steps": recognised.used,
            "score_is": score_name(recognised.used),
            "mean_confidence": float(recognised.confidence.mean()),
        },
    )
