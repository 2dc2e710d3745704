"""Search: the candidates of the frames of a source, among all frames of a map in memory, or by the
index of a large one."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..channels.camera import MOST_PAIRS, camera_of
from ..channels.channel import FEATURES, Channel, View, channels_of, refuse_text
from ..channels.features import Features
from ..database.database import Database
from ..database.frames import FrameSet
from ..datasets.image_files import Pixels
from ..datasets.names import check_sequences, name_of
from ..descriptor import SSRVLAD
from ..encoding.encoder import check_segmenter, encode_to_memory
from ..encoding.results import Progress, Skipped, do_nothing
from ..encoding.source import SelectedFrames
from ..evaluation.measure import TOP
from ..native.map import DescriptorMap
from ..recognition.matching import checked_number
from ..recognition.recognise import Recognised, Steps, recognise, references_of, runs
from ..recognition.sequences import MIN_FRAMES
from ..recognition.sweep import COLUMNS
from ..recognition.temporal import temporal_sum
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace, label_space
from .answers import Answer, Answers, check_limits
from .index import LEAST_ROWS, is_indexed
from .selection import Near, Posed, neighbours, select
from .shortlist import Shortlist

_ALONE, _SURE = Steps(follow=None), 0.9


def search(
    database: Database,
    source: SelectedFrames,
    steps: Steps,
    top: int,
    temporal: int = 0,
    channels: Sequence[str] | None = None,
    sequences: Sequence[str] | None = None,
    exclude: int | None = None,
    near: Near | Posed | None = None,
    progress: Progress = do_nothing,
    single: bool = False,
    min_confidence: float = 0.0,
    max_wrong: float | None = None,
) -> Answers:
    """The ``top`` candidates of every frame of a source, label maps, pictures or another database,
    in a database. ``temporal`` is t of the temporal sum of Eq. 3; ``channels`` and ``sequences``
    are names of those that are used, by default all; frames ``exclude`` rows around the query in
    its own sequence are no candidates, nor those of a pose outside ``near``. With ``single`` each
    frame is matched without the others. For ``min_confidence`` and ``max_wrong`` see `Answers`. A
    source that lacks a channel, and what does not go together, are a ValueError."""
    check_limits(min_confidence, max_wrong)  # before hours of work
    steps = _ALONE if single else steps
    used = chosen_channels(database, channels)
    for channel in used if temporal else ():
        if channel.dtype == "uint8":
            raise ValueError(
                f"{channel.name} are signs, which have no temporal sum; expected --channel ssr-vlad"
            )
    count = len(database)
    if not count:
        raise ValueError(f"{database.path} holds no frames yet")
    most = max(count, TOP)
    top = most if isinstance(top, int) and top > most else checked_number("top", top, least=1)
    if source.database:
        queries = _stored_queries(database, source, source.database, used)
        skipped = list[Skipped]()
    else:
        space, columns = space_of_queries(database, source, used), COLUMNS if steps.sweep else ()
        queries, skipped = encode_to_memory(
            used, space, source.files, source.selection.workers, progress, source.segmenter, columns
        )
    exact = temporal or steps.follow == "online"  # a shortlist is made of all queries
    shortlist, reason = (None, "") if exact else open_shortlist(database, used)
    references = shortlist.frames if shortlist else database.load()
    where = np.ones(len(references.frames), bool)
    if sequences is not None:
        where = select(references, sequences)
    if near:
        poses = np.where(where[:, None], references.poses, np.nan)
        where &= near.rows(poses, database.path)
    for channel in used if temporal else ():
        for run in runs(references.sequences):
            rows = slice(run.start, run.stop)
            summed = references.channels[channel.name][rows]
            temporal_sum(summed, references.sequences[rows], temporal, out=summed)
    excluded = None if exclude is None else neighbours(queries.frames, references, exclude)
    apart = dataclasses.replace(queries, sequences=queries.frames) if single else queries
    recognised = recognise_in(shortlist or references, apart, used, steps, top, where, excluded)
    if near:
        recognised.used["near"] = f"{near}: {where.sum()} frames"
    if shortlist or reason:
        recognised.used["index"] = reason or "candidates of the index"
    if Features.name in queries.channels:
        recognised.used["camera"] = _cameras(queries, shortlist or references, recognised)
    return Answers(
        queries, references, recognised, temporal, tuple(skipped), min_confidence, max_wrong
    )


def chosen_channels(database: Database, names: Sequence[str] | None = None) -> list[Channel]:
    """The channels of a database, all or those with these names; others are a ValueError."""
    columns = list(database.columns)
    if names is not None:
        refuse_text(names)
        stored = [column.name for column in columns]
        if missing := [name for name in names if name not in stored]:
            raise ValueError(
                f"{database.path} holds {', '.join(stored)} of every frame, not {missing[0]}; "
                f"encode a new database with --channel {missing[0]}"
            )
        columns = [column for column in columns if column.name in names]
    return channels_of(columns, SSRVLAD(database.config))


def space_of_queries(
    database: Database, source: SelectedFrames, channels: Sequence[Channel]
) -> LabelSpace:
    """The label space of a source that is to be described by some channels of a database. One that
    lacks a channel, and a network whose features are others, are a ValueError."""
    space = label_space(source.labels_as)
    if source.segmenter:
        head = SSRVLAD(dataclasses.replace(database.config, labels_as=space))
        check_segmenter(source.segmenter, head, channels)
    elif any(channel.lacks(None) for channel in channels):
        raise no_channels(database, channels)
    return space


def no_channels(database: Database, channels: Sequence[Channel]) -> ValueError:
    """What is raised where a source lacks channels of pictures."""
    able = " ".join(f"--channel {c.name}" for c in channels if not c.lacks(None))
    return ValueError(
        f"{database.path} holds descriptors of pictures; expected images and --segmenter, or "
        f"{able or 'channels of label maps'}"
    )


def _stored_queries(
    database: Database, source: SelectedFrames, queries: Database, channels: Sequence[Channel]
) -> FrameSet:
    """The frames of another database, by some channels."""
    if queries.fingerprint != database.fingerprint:
        raise ValueError(
            f"{queries.path} has fingerprint {queries.fingerprint or 'none'}, {database.path} has "
            f"{database.fingerprint or 'none'}: their descriptors do not compare"
        )
    if not {channel.column for channel in channels} <= set(queries.columns):
        raise no_channels(database, channels)
    frames, name = queries.load(), source.selection.sequence
    used = {channel.name: frames.channels[channel.name] for channel in channels}
    frames = dataclasses.replace(frames, channels=used)
    if name is None:
        check_sequences(source.folders, source.map_folders)
        return frames
    if len(set(frames.sequences)) > 1:
        raise ValueError(f"--sequence names one sequence, {queries.path} holds several")
    ids = tuple(f"{name}/{name_of(frame)}" for frame in frames.frames)
    return dataclasses.replace(frames, frames=ids, sequences=(name,) * len(frames))


def open_shortlist(database: Database, channels: Sequence[Channel]) -> tuple[Shortlist | None, str]:
    """The shortlist of a database with an index, from `LEAST_ROWS` frames on; or none, and why,
    empty for a smaller database and for one without an index."""
    if len(database) < LEAST_ROWS or not is_indexed(database):
        return None, ""
    try:
        return Shortlist(database, channels), ""
    except ValueError as error:
        return None, str(error)


def recognise_in(
    references: FrameSet | Shortlist,
    queries: FrameSet,
    channels: Sequence[Channel],
    steps: Steps,
    top: int,
    where: npt.NDArray[np.bool_] | None = None,
    excluded: npt.NDArray[np.int64] | None = None,
) -> Recognised:
    """Candidates of queries among the frames of a map, by some channels; see `recognise`. ``where``
    ``(R,)`` bool are the rows that may be candidates."""
    arrays = {channel.name: queries.channels[channel.name] for channel in channels}
    if isinstance(references, FrameSet):
        allowed = None if where is None or where.all() else where
        town = map_of(references, channels)
        return recognise(arrays, queries.sequences, town, steps, top, allowed, excluded)
    allowed = np.ones(len(references.frames), bool) if where is None else where

    def shortlisted(rows: slice) -> DescriptorMap:
        sequence = {name: values[rows] for name, values in arrays.items()}
        standardise = steps.standardise and rows.stop - rows.start >= MIN_FRAMES
        outside = None if excluded is None else excluded[rows]
        followed = bool(steps.follow)
        return references.of(sequence, standardise, steps.sweep, followed, top, allowed, outside)

    return recognise(arrays, queries.sequences, shortlisted, steps, top, excluded=excluded)


def map_of(references: FrameSet, channels: Sequence[Channel]) -> DescriptorMap:
    """The frames of a map by some channels, as they are compared."""
    arrays = {channel.name: references.channels[channel.name] for channel in channels}
    trust = {channel.name: channel.trust for channel in channels}
    return references_of(arrays, references.sequences, trust)


def _cameras(
    queries: FrameSet, references: FrameSet | Shortlist, recognised: Recognised
) -> dict[str, dict[str, Any]]:
    """How the camera of each sequence of queries differs from that of the map, by the features of
    answers that are surely right; nothing for a sequence with few of these."""
    answers, name = recognised.matches.indices[:, 0].numpy(), Features.name
    sure, cameras = recognised.confidence.numpy() >= _SURE, {}
    for run in runs(queries.sequences):
        rows = np.arange(run.start, run.stop)[sure[run.start : run.stop]]
        rows = rows[:: max(1, -(-len(rows) // MOST_PAIRS))]
        if isinstance(references, FrameSet):
            frames = np.asarray(references.channels[name][answers[rows]])
        else:
            frames = references.read(answers[rows])[name]
        if camera := camera_of(np.asarray(queries.channels[name][rows]), frames):
            cameras[queries.sequences[run.start]] = camera._asdict()
    return cameras


def views_of(
    segmenter: Segmenter,
    pictures: Sequence[Pixels],
    names: Sequence[str],
    channels: Sequence[Channel],
) -> list[View]:
    """Pictures with what the network says of them, as far as channels need it."""
    features = any(FEATURES in channel.needs for channel in channels)
    segmented = segmenter.segment(pictures, features=features)
    return [
        View(name, result.labels, segmenter.label_space, picture, result.features)
        for name, picture, result in zip(names, pictures, segmented, strict=True)
    ]


class LoadedMap:
    """The frames of a map in memory, or by the index of a large one, for pictures by themselves,
    which the network labels that ``open_segmenter`` gives for the channels of the map.

    Attributes:
        version: of the database.
    """

    def __init__(
        self, database: Database, open_segmenter: Callable[[Sequence[Channel]], Segmenter]
    ) -> None:
        if not len(database):
            raise ValueError(f"{database.path} holds no frames yet")
        self.version, self._path = database.version, database.path
        self._channels = chosen_channels(database)
        self._segmenter = open_segmenter(self._channels)
        shortlist, reason = open_shortlist(database, self._channels)
        if reason:
            warnings.warn(f"{reason}; all frames are loaded", stacklevel=4)
        self._references = shortlist or database.load()

    def locate(
        self, pictures: Sequence[Pixels], top: int, near: Near | Posed | None
    ) -> list[Answer]:
        """The answers to pictures, each by itself."""
        references, channels = self._references, self._channels
        frames = references if isinstance(references, FrameSet) else references.frames
        where = near.rows(frames.poses, self._path) if near else None
        names, answers = [f"picture/{number}" for number in range(len(pictures))], list[Answer]()
        for view in views_of(self._segmenter, pictures, names, channels):
            described = {channel.name: channel.describe([view], COLUMNS) for channel in channels}
            unknown, full = np.full((1, 3), np.nan), bool(next(iter(described.values())).any())
            ids, empty = ((view.frame,), (view.sequence,)), np.array([not full])
            queries = FrameSet(*ids, described, unknown, unknown[:, 0], empty)
            few = min(top, len(frames))
            recognised = recognise_in(references, queries, channels, _ALONE, few, where)
            answers += Answers(queries, frames, recognised)
        return answers
