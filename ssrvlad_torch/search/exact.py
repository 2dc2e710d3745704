"""Search: the candidates of the frames of a source, among all frames of a map in memory."""

import dataclasses
from bisect import bisect_left
from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..channels.channel import Channel, View, channels_of
from ..database.database import Database
from ..database.frames import FrameSet
from ..datasets.names import KnownFolders, check_sequences, name_of, split_id
from ..descriptor import SSRVLAD
from ..encoding.encoder import check_segmenter, encode_to_memory
from ..encoding.results import Progress, Skipped, do_nothing
from ..encoding.source import Source
from ..files import natural_key
from ..recognition.comparison import Member
from ..recognition.follow import runs
from ..recognition.recognise import Recognised, Steps, recognise
from ..recognition.sweep import COLUMNS
from ..recognition.temporal import temporal_sum
from ..taxonomy import label_space
from .answers import Answer, Answers
from .near import Near

_ALONE = Steps(follow=None)


def search(
    database: Database,
    source: Source,
    steps: Steps,
    top: int,
    temporal: int = 0,
    channels: Sequence[str] | None = None,
    sequences: Sequence[str] | None = None,
    exclude: int | None = None,
    near: Near | None = None,
    progress: Progress = do_nothing,
) -> Answers:
    """The ``top`` candidates of every frame of a source in a database.

    Args:
        database: the map.
        source: label maps, pictures, or another database.
        steps: of `recognise`.
        top: number of candidates of each frame.
        temporal: t of the temporal sum of Eq. 3, in frames.
        channels: names of those that are used; by default all of the database.
        sequences: of the candidates; by default all.
        exclude: frames around the query in its own sequence that are no candidates.
        near: where the poses of candidates are; by default anywhere.
        progress: called with 1 for every frame.

    Raises:
        ValueError: the source lacks a channel, or what was asked for does not go together.
    """
    used = chosen_channels(database, channels)
    if temporal and any(each.column.dtype != "float32" for each in used):
        raise ValueError(
            "features are signs, which have no temporal sum; expected --channel ssr-vlad"
        )
    references = database.load()
    if not references.frames:
        raise ValueError(f"{database.path} holds no frames yet")
    names = [channel.column.name for channel in used]
    if temporal:
        for name in names:
            for run in runs(references.sequences):
                rows = references.channels[name][run.start : run.stop]
                temporal_sum(rows, references.sequences[run.start : run.stop], temporal, out=rows)
    columns = COLUMNS if steps.sweep else ()
    queries, skipped, folders = queries_of(database, source, used, columns, progress)
    where = select(references, sequences)
    if near:
        poses = np.where(where[:, None], references.poses, np.nan)
        where &= near.rows(poses, database.path)
    without = excluded_pairs(queries, references, where, exclude)
    recognised = recognise_in(references, queries, used, steps, top, without)
    if near:
        recognised.used["near"] = f"{near}: {where.sum()} frames"
    return Answers.of(queries, references, recognised, temporal, tuple(skipped), folders)


def chosen_channels(database: Database, names: Sequence[str] | None = None) -> list[Channel]:
    """The channels of a database, all or those with these names; others are a ValueError."""
    stored = [column.name for column in database.columns]
    if isinstance(names, str):
        raise ValueError(f"expected a list of channels, got the text {names!r}")
    if names is not None and (missing := [name for name in names if name not in stored]):
        raise ValueError(
            f"{database.path} holds {', '.join(stored)} of every frame, not {missing[0]}; encode a "
            f"new database with --channel {missing[0]}"
        )
    head = SSRVLAD(database.config)
    return channels_of([c for c in database.columns if names is None or c.name in names], head)


def recognise_in(
    references: FrameSet,
    queries: FrameSet,
    channels: Sequence[Channel],
    steps: Steps,
    top: int,
    excluded: Tensor | None = None,
) -> Recognised:
    """Candidates of queries among the frames of a map, by some channels; see `recognise`."""
    members = {
        channel.column.name: Member(
            queries.channels[channel.column.name],
            channel.references(references.channels[channel.column.name], references.sequences),
            channel.trust,
        )
        for channel in channels
    }
    return recognise(members, queries.sequences, references.sequences, steps, top, excluded)


def locate_view(
    view: View,
    references: FrameSet,
    channels: Sequence[Channel],
    top: int,
    excluded: Tensor | None = None,
) -> Answer:
    """The answer to one picture alone; ``excluded`` ``(1, R)`` as for `recognise`."""
    descriptors = {each.column.name: each.describe([view], COLUMNS) for each in channels}
    unknown, empty = np.full((1, 3), np.nan), not bool(next(iter(descriptors.values())).any())
    queries = FrameSet(
        (view.frame,), (view.sequence,), descriptors, unknown, unknown[:, 0], np.array([empty])
    )
    top = min(top, len(references))
    recognised = recognise_in(references, queries, channels, _ALONE, top, excluded)
    [answer] = Answers.of(queries, references, recognised)
    return answer


def queries_of(
    database: Database,
    source: Source,
    channels: Sequence[Channel],
    columns: Sequence[int] = (),
    progress: Progress = do_nothing,
) -> tuple[FrameSet, list[Skipped], KnownFolders]:
    """The frames of a source, the skipped frames, and the folders of the sequences. Frames are
    described by some channels of the database, from anchors, if any; a source that is a database is
    loaded."""
    if source.database:
        return _loaded(database, source, source.database, channels)
    no_pictures = no_channels(database, channels)
    if not source.segmenter and any(channel.lacks(None) for channel in channels):
        raise no_pictures
    space, segmenter = label_space(source.labels_as), source.segmenter
    head = SSRVLAD(dataclasses.replace(database.config, labels_as=space))
    check_segmenter(segmenter, head, channels)
    files, workers = source.files, source.wanted.workers
    frames, skipped = encode_to_memory(
        channels, space, files, workers, progress, segmenter, columns
    )
    return frames, skipped, {(file.folder, file.sequence) for file in files}


def no_channels(database: Database, channels: Sequence[Channel]) -> ValueError:
    """What is raised where a source lacks channels of pictures."""
    able = " ".join(f"--channel {each.column.name}" for each in channels if not each.lacks(None))
    return ValueError(
        f"{database.path} holds descriptors of pictures; expected images and --segmenter, or "
        f"{able or 'channels of label maps'}"
    )


def _loaded(
    database: Database, source: Source, other: Database, channels: Sequence[Channel]
) -> tuple[FrameSet, list[Skipped], KnownFolders]:
    """The frames of another database, by some channels."""
    if other.fingerprint != database.fingerprint:
        raise ValueError(
            f"{other.path} has fingerprint {other.fingerprint or 'none'}, {database.path} has "
            f"{database.fingerprint or 'none'}: their descriptors do not compare"
        )
    if not {channel.column for channel in channels} <= set(other.columns):
        raise no_channels(database, channels)
    frames, name = other.load(), source.wanted.sequence
    used = {each.column.name: frames.channels[each.column.name] for each in channels}
    frames = dataclasses.replace(frames, channels=used)
    if name is None:
        folders = other.folders()
        check_sequences(folders, source.known)
        return frames, [], folders
    if len(set(frames.sequences)) > 1:
        raise ValueError(f"--sequence names one sequence, {other.path} holds several")
    ids = tuple(f"{name}/{name_of(frame)}" for frame in frames.frames)
    named = dataclasses.replace(frames, frames=ids, sequences=(name,) * len(frames))
    return named, [], ()


def select(frames: FrameSet, sequences: Collection[str] | None = None) -> npt.NDArray[np.bool_]:
    """``(R,)`` bool, the frames of some sequences, by default all; others are a ValueError."""
    if sequences is None:
        return np.ones(len(frames), bool)
    missing = sorted(set(sequences) - set(frames.sequences))
    if missing:
        raise ValueError(f"there is no sequence {missing[0]!r} in the database")
    return np.fromiter((s in sequences for s in frames.sequences), bool, len(frames))


def neighbours(queries: Sequence[str], references: FrameSet, reach: int) -> npt.NDArray[np.int64]:
    """The references around each query in its own sequence: ``(Q, 2)`` int64, the first of these
    rows and the one after the last, with the query's own. ``reach`` is the number of frames, from
    0, on each side of the position that the query has or would have among the references, which are
    in natural order."""
    if reach < 0:
        raise ValueError(f"the reach of neighbours must be 0 or more frames, got {reach}")
    starts: dict[str, int] = {}
    ends: dict[str, int] = {}
    for row, sequence in enumerate(references.sequences):
        starts.setdefault(sequence, row)
        ends[sequence] = row + 1
    ranges = np.zeros((len(queries), 2), np.int64)
    for number, query in enumerate(queries):
        sequence, name = split_id(query)
        if sequence in starts:
            start, end = starts[sequence], ends[sequence]
            place = bisect_left(
                references.frames,
                natural_key(name),
                start,
                end,
                key=lambda frame: natural_key(name_of(frame)),
            )
            is_reference = place < end and references.frames[place] == query
            ranges[number] = max(start, place - reach), min(end, place + reach + is_reference)
    return ranges


def excluded_pairs(
    queries: FrameSet, references: FrameSet, where: npt.NDArray[np.bool_], reach: int | None
) -> Tensor | None:
    """``(Q, R)`` bool, the references that are no candidates of a query: those not in ``where``
    ``(R,)`` bool, and its `neighbours` within a reach, if any; ``None`` if all
    are."""
    import torch

    if where.all() and reach is None:
        return None
    excluded = np.repeat(~where[None], len(queries), axis=0)
    if reach is not None:
        first, last = neighbours(queries.frames, references, reach).T[:, :, None]
        rows = np.arange(len(references))
        excluded |= (rows >= first) & (rows < last)
    return torch.from_numpy(excluded)
