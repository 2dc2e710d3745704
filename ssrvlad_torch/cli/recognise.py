"""The candidates that ``ssrvlad evaluate`` measures: by a database, or by another method."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..database.database import Database
from ..datasets.image_files import find_image_files
from ..datasets.label_files import find_label_files
from ..encoding.results import cores
from ..evaluation.metrics import Convention
from ..evaluation.report import Descriptors
from ..recognition.recognise import AS_PAPER
from ..recognition.sweep import COLUMNS, score
from .measure import TOP, Recognition, needs_similarity
from .methods import has_setting, make, parse_settings, run_method
from .options import MethodOptions, RecognitionOptions
from .pictures import pictures_of_files, pictures_of_queries, pictures_of_references
from .report import CANDIDATES, Page
from .search import confident, search, settings_of, steps_of
from .sources import Source
from .truth import Places


def by_database(
    database: Database,
    source: Source,
    options: RecognitionOptions,
    convention: Convention,
    page: Page | None,
) -> Recognition:
    """The candidates of every query in a database, with pictures for the page if one is given. A
    convention that needs the scores of all pairs measures cosines, without any step."""
    pairs = needs_similarity(convention)
    queries, references, recognised, t, skipped, folders = search(
        database, source, options, CANDIDATES if page else TOP, AS_PAPER if pairs else None
    )
    if queries.descriptors.ndim == 3:
        middle = queries.descriptors[:, COLUMNS.index(0)].contiguous()
        queries = dataclasses.replace(queries, descriptors=middle)
    config = settings_of(database, source.labels_as)
    similarity = None
    if pairs:
        similarity = score(queries.descriptors, references.descriptors).numpy()
    return Recognition(
        references=Places.of_set(references, source.whole, source.known),
        queries=Places.of_set(queries, source.whole, folders, [f.frame for f in skipped]),
        matches=confident(recognised, options.min_confidence),
        similarity=similarity,
        descriptors=Descriptors.of(queries.descriptors, references.descriptors, config),
        pictures=(
            pictures_of_queries(source, config.labels_as),
            pictures_of_references(
                database, source, page.pictures if page else (), config.labels_as
            ),
        ),
        skipped=skipped,
        details={
            "preset": config.preset,
            "fingerprint": config.fingerprint,
            "temporal": t,
            "steps": recognised.used,
            "mean_confidence": float(recognised.confidence.mean()),
        },
    )


def by_method(
    options: MethodOptions,
    references: Path,
    source: Source,
    recognition: RecognitionOptions,
    convention: Convention,
    page: Page | None,
) -> Recognition:
    """The candidates of every query by another method, in the frames of a folder."""
    assert options.method is not None
    for name in options.named:
        if not has_setting(options.method, name):
            raise ValueError(f"method {options.method} takes no --{name.replace('_', '-')}")
    settings = {**parse_settings(options.settings or ()), **options.named}
    method = make(options.method, settings)
    labelled = "labels" in method.needs
    if labelled and source.labels_as is None:
        raise ValueError(f"method {method.name} reads label maps; expected their --labels-as")
    reference_files = (find_label_files if labelled else find_image_files)([str(references)])
    known = {(file.folder, file.sequence) for file in reference_files}
    source = dataclasses.replace(source, known=known)
    query_files = source.label_files() if labelled else source.image_files()
    labels_as = source.labels_as if labelled else None
    all_pairs = needs_similarity(convention) or page is not None
    steps = None if needs_similarity(convention) else steps_of(recognition)
    workers = source.options.workers or cores()
    found = run_method(method, reference_files, query_files, labels_as, workers, all_pairs, steps)[
        -1
    ]
    pictures = (
        pictures_of_files(query_files, labels_as),
        pictures_of_files(reference_files, labels_as),
    )
    return dataclasses.replace(found, pictures=pictures)
