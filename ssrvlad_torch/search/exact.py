"""Search: the candidates of the frames of a source, among all frames of a map in memory, or by the
index of a large one."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..channels.channel import Channel, View, channels_of, refuse_text
from ..database.database import Database
from ..database.frames import FrameSet
from ..datasets.names import KnownFolders, check_sequences, name_of
from ..descriptor import SSRVLAD
from ..encoding.encoder import check_segmenter, encode_to_memory
from ..encoding.results import Progress, Skipped, do_nothing
from ..encoding.source import SelectedFrames
from ..recognition.comparison import Member
from ..recognition.recognise import Recognised, Steps, recognise
from ..recognition.sequences import runs
from ..recognition.sweep import COLUMNS
from ..recognition.temporal import temporal_sum
from ..taxonomy import label_space
from .alone import LargeMap, opened_large
from .answers import Answer, Answers
from .drive import recognise_in_large
from .near import Near
from .selection import excluded_pairs, select

_ALONE = Steps(follow=None)


def search(
    database: Database,
    source: SelectedFrames,
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
    signs = [channel.name for channel in used if channel.dtype == "uint8"]
    if temporal and signs:
        raise ValueError(
            f"{signs[0]} are signs, which have no temporal sum; expected --channel ssr-vlad"
        )
    if not len(database):
        raise ValueError(f"{database.path} holds no frames yet")
    columns = COLUMNS if steps.sweep else ()
    queries, skipped, folders = queries_of(database, source, used, columns, progress)
    large = "" if temporal else opened_large(database, used)
    references = database.load() if isinstance(large, str) else large.frames
    where = select(references, sequences)
    if near:
        poses = np.where(where[:, None], references.poses, np.nan)
        where &= near.rows(poses, database.path)
    if isinstance(large, str):
        _sum_over_time(references, used, temporal)
        without = excluded_pairs(queries, references, where, exclude)
        recognised = recognise_in(references, queries, used, steps, top, without)
    else:
        recognised = recognise_in_large(large, queries, steps, top, where, exclude)
    if near:
        recognised.used["near"] = f"{near}: {where.sum()} frames"
    if large:
        recognised.used["index"] = large if isinstance(large, str) else "candidates of the index"
    return Answers(queries, references, recognised, temporal, tuple(skipped), folders)


def _sum_over_time(references: FrameSet, channels: Sequence[Channel], temporal: int) -> None:
    """Replaces the descriptors of a map by their temporal sums, if any."""
    for channel in channels if temporal else ():
        for run in runs(references.sequences):
            part = slice(run.start, run.stop)
            rows = references.channels[channel.column.name][part]
            temporal_sum(rows, references.sequences[part], temporal, out=rows)


def chosen_channels(database: Database, names: Sequence[str] | None = None) -> list[Channel]:
    """The channels of a database, all or those with these names; others are a ValueError."""
    stored = [column.name for column in database.columns]
    refuse_text(names)
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
    references: FrameSet | LargeMap,
    channels: Sequence[Channel],
    top: int,
    where: npt.NDArray[np.bool_],
) -> Answer:
    """The answer to one picture alone, among the rows ``where`` ``(R,)`` bool of a map."""
    descriptors = {each.column.name: each.describe([view], COLUMNS) for each in channels}
    unknown, empty = np.full((1, 3), np.nan), not bool(next(iter(descriptors.values())).any())
    queries = FrameSet(
        (view.frame,), (view.sequence,), descriptors, unknown, unknown[:, 0], np.array([empty])
    )
    top = min(top, len(where))
    if isinstance(references, FrameSet):
        without = excluded_pairs(queries, references, where, None)
        recognised = recognise_in(references, queries, channels, _ALONE, top, without)
    else:
        recognised = recognise_in_large(references, queries, _ALONE, top, where)
        references = references.frames
    [answer] = Answers(queries, references, recognised)
    return answer


def queries_of(
    database: Database,
    source: SelectedFrames,
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
    files, workers = source.files, source.selection.workers
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
    database: Database, source: SelectedFrames, other: Database, channels: Sequence[Channel]
) -> tuple[FrameSet, list[Skipped], KnownFolders]:
    """The frames of another database, by some channels."""
    if other.fingerprint != database.fingerprint:
        raise ValueError(
            f"{other.path} has fingerprint {other.fingerprint or 'none'}, {database.path} has "
            f"{database.fingerprint or 'none'}: their descriptors do not compare"
        )
    if not {channel.column for channel in channels} <= set(other.columns):
        raise no_channels(database, channels)
    frames, name = other.load(), source.selection.sequence
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
