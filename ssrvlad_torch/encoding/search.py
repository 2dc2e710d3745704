"""Candidates of queries in a database."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor

from ..database.database import Database
from ..database.frames import FrameSet
from ..database.index_search import IndexSearch
from ..database.metadata import ExtraDescriptor
from ..database.selection import excluded_pairs, select
from ..datasets.names import KnownFolders, check_sequences
from ..descriptor import mirrored, query_head
from ..recognition.confidence import Estimate, accept, answered, estimate
from ..recognition.matching import Matches
from ..recognition.recognise import SSR_VLAD, Recognised, Steps, recognise, recognise_by_search
from ..recognition.standardise import MIN_FRAMES
from ..recognition.sweep import COLUMNS
from ..recognition.temporal import temporal_sum
from .encoder import encode_to_memory
from .extra_descriptors import extra_methods
from .results import Progress, Skipped, do_nothing
from .source import Source


class Found(NamedTuple):
    """The frames of a source and of the database, the candidates of every query, t of Eq. 3, the
    frames that could not be encoded, and the folders of the sequences of the queries."""

    queries: FrameSet
    references: FrameSet
    recognised: Recognised
    temporal: int
    skipped: list[Skipped]
    folders: KnownFolders


def search(
    database: Database,
    source: Source,
    steps: Steps,
    top: int,
    reach: int = 0,
    extra: bool | None = None,
    sequences: Sequence[str] | None = None,
    exclude: int | None = None,
    progress: Progress = do_nothing,
) -> Found:
    """The ``top`` candidates of every frame of a source in a database, by the ``steps`` of
    `recognise`; a ValueError if they do not fit. ``progress`` is called with 1 for every frame.

    ``reach`` is the number of frames on each side of the temporal sum (Eq. 3). ``extra`` says
    whether to use the extra descriptors, ``None`` if there are any. Candidates are the frames of
    some sequences, by default all, but not those within ``exclude`` frames of the query in its own
    sequence.
    """
    if extra and not database.extra:
        raise ValueError(
            f"--extra: {database.path} holds no extra descriptors; encode a new database with "
            "--with features"
        )
    methods = () if extra is False else database.extra
    if reach and any(each.cells for each in methods):
        raise ValueError("features are signs, which have no temporal sum; expected --no-extra")
    references = database.load()
    if not references.frames:
        raise ValueError(f"{database.path} holds no frames yet")
    if reach:
        numbers = [each for each in references.extra.values() if each.is_floating_point()]
        for values in (references.descriptors, *numbers):
            temporal_sum(values, references.sequences, reach, out=values)
    columns = COLUMNS if steps.sweep else ()
    queries, skipped, folders = _queries(database, source, columns, methods, progress)
    where, vectors = select(references, sequences), queries.descriptors
    without = excluded_pairs(queries, references, where, exclude)
    recognised = recognise_in(
        database, references, vectors, queries.extra, queries.sequences, steps, top, without
    )
    return Found(queries, references, recognised, reach, skipped, folders)


def recognise_in(
    database: Database,
    references: FrameSet,
    queries: Tensor,
    extra: Mapping[str, Tensor],
    sequences: Sequence[str],
    steps: Steps,
    top: int,
    excluded: Tensor | None = None,
) -> Recognised:
    """Candidates of queries ``(Q, D)`` or ``(Q, S, D)``, with extra descriptors by name, among the
    frames of a database, by all methods; see `recognise`."""
    methods = extra_methods([each for each in database.extra if each.name in extra])
    return recognise(
        queries,
        references.descriptors,
        sequences,
        references.sequences,
        steps,
        top,
        excluded,
        {name: (values, references.extra[name]) for name, values in extra.items()},
        {
            SSR_VLAD: partial(mirrored, config=database.config),
            **{method.name: method.mirrored for method in methods},
        },
    )


def search_by_index(
    database: Database,
    source: Source,
    steps: Steps,
    top: int,
    sequences: Sequence[str] | None,
    exclude: int | None,
    progress: Progress = do_nothing,
) -> Found:
    """The candidates of every frame of a source in the index of a database, without a sweep, see
    `search`."""
    queries, skipped, folders = _queries(database, source, progress=progress)
    ids, names = queries.frames, queries.sequences

    @cache
    def index(standardised: bool) -> IndexSearch:
        return IndexSearch(
            database, queries.descriptors, names, standardised, sequences, (ids, exclude)
        )

    @cache
    def decoys(standardised: bool) -> IndexSearch:
        return index(standardised).mirrored(partial(mirrored, config=database.config))

    long = names.count(names[0]) >= MIN_FRAMES if names else False
    references = index(steps.standardise and long).frames
    recognised = recognise_by_search(index, names, references.sequences, steps, top, decoys)
    return Found(queries, references, recognised, 0, skipped, folders)


def accepted(
    recognised: Recognised, min_confidence: float, max_wrong: float | None
) -> tuple[Matches, Estimate]:
    """The candidates of the accepted queries, and an estimate of how many of them are wrong. All
    with a confidence of at least ``min_confidence`` are accepted, or, if ``max_wrong`` is given, as
    many as this fraction of wrong answers permits. Scores that are rounded above 1 are 1."""
    if max_wrong is None:
        found, least = estimate(recognised.sure, min_confidence), min_confidence
    else:
        found = accept(recognised.sure, max_wrong)
        least = found.confidence
    unsure = recognised.confidence < least
    if least > 0:
        unsure |= ~answered(recognised.sure)
    unsure = unsure[:, None]
    scores, indices = recognised.matches
    scores = scores.clamp(max=1).masked_fill(unsure, -torch.inf)
    return Matches(scores, indices.masked_fill(unsure, -1)), found


def _queries(
    database: Database,
    source: Source,
    columns: Sequence[int] = (),
    extra: Sequence[ExtraDescriptor] = (),
    progress: Progress = do_nothing,
) -> tuple[FrameSet, list[Skipped], KnownFolders]:
    """The frames of a source, the skipped frames, and the folders of the sequences. Frames are
    encoded with the settings of the database, as ``(Q, S, 480)`` from anchors, if any, and with
    extra descriptors; a source that is a database is loaded."""
    no_pictures = ValueError(
        f"{database.path} holds descriptors of pictures; expected images and --segmenter, or "
        "--no-extra"
    )
    if not (other := source.database):
        config = dataclasses.replace(database.config, labels_as=source.labels_as)
        if extra and not source.segmenter:
            raise no_pictures
        head, files = query_head(config, columns), source.files
        frames, skipped = encode_to_memory(
            head, files, source.workers, progress, source.segmenter, extra
        )
        return frames, skipped, {(file.folder, file.sequence) for file in files}
    if other.fingerprint != database.fingerprint:
        raise ValueError(
            f"{other.path} has fingerprint {other.fingerprint or 'none'}, {database.path} has "
            f"{database.fingerprint or 'none'}: their descriptors do not compare"
        )
    frames = other.load()
    if not set(extra) <= set(other.extra):
        raise no_pictures
    used = {method.name: frames.extra[method.name] for method in extra}
    frames = dataclasses.replace(frames, extra=used)
    if (name := source.sequence) is None:
        folders = other.folders()
        check_sequences(folders, source.known)
        return frames, [], folders
    if len(set(frames.sequences)) > 1:
        raise ValueError(f"--sequence names one sequence, {other.path} holds several")
    ids = tuple(f"{name}/{frame.rpartition('/')[2]}" for frame in frames.frames)
    named = dataclasses.replace(frames, frames=ids, sequences=(name,) * len(frames))
    return named, [], ()
