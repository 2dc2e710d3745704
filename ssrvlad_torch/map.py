"""Map: known places. Add sequences, find others in it, measure how well that goes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, overload

import numpy as np
from PIL import Image

from .channels.channel import Channel
from .config import SSRVLADConfig
from .database.database import Database
from .database.engine import discard_empty
from .datasets.dataset import GroundTruth
from .datasets.frame_file import frame_in_memory
from .datasets.image_files import Picture, pixels_of
from .datasets.label_files import LabelMap
from .encoding.encoder import Describer, encode_to_database, method_for
from .encoding.named import encode_names
from .encoding.ray_engine import encode_with_ray
from .encoding.results import EncodeOptions, Note, Progress, Skipped, Summary, do_nothing
from .encoding.selection import STDIN, FrameSelection
from .encoding.source import (
    SelectedFrames,
    note_other_spaces,
    note_void,
    open_frames,
    require_network,
    up_to_date,
)
from .evaluation.measure import TOP, Evaluation
from .evaluation.metrics import Convention
from .recognition.matching import checked_number
from .recognition.recognise import Steps
from .search.answers import Answer, Answers
from .search.exact import LoadedMap, chosen_channels, search, space_of_queries
from .search.index import grow
from .search.material import Material, draw_answers, evaluate_answers, posed_references
from .search.selection import Circle, circle_of
from .search.tracker import Tracker
from .segmentation.segmenter import Segmenter
from .taxonomy import LabelSpace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Frames = str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | FrameSelection
"""Folders, globs or files, each folder a sequence; or `FrameSelection`, which says more."""

_LIVE = FrameSelection([STDIN])

AnyFrames = Frames | SelectedFrames | Sequence[Picture | LabelMap]


@dataclass(repr=False, eq=False)
class Map:
    """Known places: the frames of a database, and the network that labels pictures. Use `open`.

    Changes that are made through this object count at once; those of other processes when the map
    is opened again. For the attributes see `open`.

    Examples:
        >>> town = Map.open("town.ssrdb", network="seg.yaml")  # doctest: +SKIP
        >>> town.add("images/monday").encoded  # doctest: +SKIP
        1000
        >>> for answer in town.query("images/today"):  # doctest: +SKIP
        ...     print(answer.query, answer.candidates[0].frame, answer.confidence)
        >>> town.locate("images/today/000007.jpg").candidates[0].frame  # doctest: +SKIP
        'monday/000007'
    """

    path: str
    network: str | Segmenter | None = None
    labels_as: str | LabelSpace | None = None
    preset: str | None = None
    channels: Sequence[str] | None = None
    version: int | None = None
    _opened: Segmenter | None = field(default=None, init=False)
    _database: Database | None = field(default=None, init=False)
    _loaded: LoadedMap | None = field(default=None, init=False)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        network: str | os.PathLike[str] | Segmenter | None = None,
        labels_as: str | LabelSpace | None = None,
        preset: str | None = None,
        channels: Sequence[str] | None = None,
        version: int | None = None,
    ) -> Map:
        """A map; a new one is made by the first `add`. A damaged database, one of another version
        of the method, and one of another preset or without these channels are a ValueError.

        Args:
            path: of the database, a folder or a URI.
            network: labels pictures; a name, see `open_network`, or a `Segmenter`. Without one,
                frames are label maps, or pictures of the network that made the map.
            labels_as: label space of the label maps, or of the network's classes.
            preset: of a new map, ``"default"``, if not given, or ``"paper"``.
            channels: of `channels.CHANNELS`, what a new map stores of pictures; by default all.
            version: of the database, opened read-only; by default the newest.
        """
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"expected the folder or URI of a map, got {path!r}")
        named = str(network) if isinstance(network, os.PathLike) else network
        if not isinstance(named, str | Segmenter | None):
            kind = type(network).__name__
            raise ValueError(f"network: expected its name, its file or a Segmenter, got {kind}")
        town = cls(str(path), named, labels_as, preset, channels, version)
        town._opened = network if isinstance(network, Segmenter) else None
        if version is not None or Database.exists(town.path):
            database = town._database = Database.open(town.path, version)
            if preset is not None:
                stored_as = database.config.labels_as
                database.require(SSRVLADConfig.from_preset(preset, labels_as=stored_as))
            if channels is not None:
                chosen_channels(database, channels)
        return town

    @property
    def database(self) -> Database:
        """The database; a ValueError before the first `add`."""
        if self._database is None:  # before it, or after one that was cut off
            self._database = Database.open(self.path)
        return self._database

    def _stored(self) -> Database | None:
        """The database; ``None`` if there is none."""
        return self.database if self._database or Database.exists(self.path) else None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.database) if self._stored() else 0

    def __repr__(self) -> str:
        return f"<Map {self.path}: {len(self)} frames>"

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError(f"a Map cannot be copied or pickled: open {self.path} again")

    def source(
        self, frames: Frames, compared: bool = False, note: Note = do_nothing, **kind: bool
    ) -> SelectedFrames:
        """The frames on disk, before the first is read; for ``kind`` see `open_frames`."""
        source = open_frames(
            frames if isinstance(frames, FrameSelection) else FrameSelection.of(frames),
            self.database if compared else self._stored(),
            network=self.network and (self._opened or self.network),
            labels_as=self.labels_as,
            compared=compared,
            opened=None if self.network else self._opened,
            note=note,
            **kind,
        )
        if source.segmenter and not isinstance(frames, FrameSelection):
            self._opened = source.segmenter
        return source

    def add(
        self,
        frames: Frames | SelectedFrames,
        options: EncodeOptions | None = None,
        engine: Literal["local", "ray"] = "local",
        note: Note = do_nothing,
    ) -> Summary:
        """Adds frames that the map lacks, and those whose file, pose or labels have changed. A new
        map that stays without frames is deleted. No frames, and frames that do not fit the map, are
        a ValueError; a map that cannot be written is an OSError.

        Args:
            frames: folders, globs or files of label maps, or of pictures with a network. The poses
                of a folder are in a ``poses.csv`` in or beside it.
            options: workers, pruning, and callbacks.
            engine: threads of this process, or Ray.
            note: gets what the user should know.
        """
        options = options or EncodeOptions()
        if self.version is not None:
            raise ValueError(f"{self.path} was opened as of version {self.version}, read-only")
        source = frames if isinstance(frames, SelectedFrames) else self.source(frames, note=note)
        network, stored = source.segmenter, self._stored()
        if engine not in ("local", "ray"):
            raise ValueError(f"engine: expected local or ray, got {engine!r}")
        if options.gpus and not (network and engine == "ray"):
            raise ValueError("--gpus needs --engine ray and --segmenter")
        labels_as, names = source.labels_as, self.channels
        head, beside = method_for(stored, self.preset, labels_as, network, names, note)
        if stored is None:
            note_void(source, note)
        self._database = None  # until all is written
        columns = [channel.column for channel in beside]
        database = Database.open_or_create(self.path, head.config, columns)
        encode = encode_with_ray if engine == "ray" else encode_to_database
        try:
            summary = encode(head, source.files, database, options, network)
        except BaseException:
            if stored is None:
                discard_empty(self.path)
            raise
        if stored is None and not len(database):
            discard_empty(self.path)
            return summary
        self._database = database
        grow(database)
        note_other_spaces(database, head.label_space, note)
        return summary

    def up_to_date(
        self, frames: FrameSelection, complete: bool = False, prune: bool = False
    ) -> Summary | None:
        """What `add` of pictures returns where it has nothing to do, without opening the network;
        else ``None``. For ``complete`` and ``prune`` see `EncodeOptions`; errors as for `add`."""
        network, labels_as = frames.segmenter or self.network, frames.labels_as or self.labels_as
        return up_to_date(frames, self._stored(), network, labels_as, complete, prune)

    def query(
        self,
        frames: AnyFrames,
        steps: Steps | None = None,
        top: int = 5,
        *,
        temporal: int = 0,
        channels: Sequence[str] | None = None,
        sequences: Sequence[str] | None = None,
        exclude: int | None = None,
        near: Circle | None = None,
        min_confidence: float = 0.0,
        max_wrong: float | None = None,
        follow: Literal["offline", "online", "no"] | None = None,
        single: bool = False,
        progress: Progress = do_nothing,
    ) -> Answers:
        """Finds a sequence, or any frames, in the map; far better a whole folder than pictures one
        by one. No frames, frames that do not fit the map, and a map without poses in the circle are
        a ValueError.

        Args:
            frames: as for `add`, or a database; or a list of pictures in memory, see `locate`, or
                of label maps ``(H, W)`` of integers, the sequence ``query``.
            steps: between descriptors and a decision; by default all.
            top: number of candidates of each frame.
            temporal, channels, sequences, exclude, progress: see `search.exact.search`.
            near: only frames whose pose is in this circle are candidates.
            min_confidence, max_wrong: which answers are accepted, see `Answers.accepted`.
            follow: instead of that of ``steps``; ``"no"`` matches single frames.
            single: match each frame without the others, as `locate` does, without ``steps``.
        """
        if single and (steps or follow not in (None, "no")):
            raise ValueError("single matches each frame by itself; expected no steps and no follow")
        circle = near if near is None else circle_of(near)
        source, steps = self._source(frames), steps or Steps()
        if not isinstance(steps, Steps):
            raise ValueError(f"expected steps as Steps, got {steps!r}")
        if follow:
            steps = replace(steps, follow=None if follow == "no" else follow)
        return search(
            self.database, source, steps, top, temporal, channels, sequences, exclude, circle,
            progress, single, min_confidence, max_wrong,
        )  # fmt: skip

    @overload
    def locate(  # type: ignore[overload-overlap]
        self, pictures: Picture, top: int = 5, near: Circle | None = None
    ) -> Answer: ...
    @overload
    def locate(
        self, pictures: Sequence[Picture], top: int = 5, near: Circle | None = None
    ) -> list[Answer]: ...
    def locate(
        self, pictures: Picture | Sequence[Picture], top: int = 5, near: Circle | None = None
    ) -> Answer | list[Answer]:
        """The places of pictures, each by itself; of a sequence, use `query`. The map is loaded,
        unless it is large and has an index, see ``ssrvlad db index``.

        Args:
            pictures: one or several: ``(H, W, 3)`` uint8 in RGB, images of Pillow, or image files.
                A missing file is a FileNotFoundError.
            top: number of candidates of each, at any confidence; none if the picture or every frame
                is empty.
            near: only frames whose pose is in this circle are candidates, such as ``(12.5, -3,
                50)`` of GPS or odometry. A map without frames there is a ValueError.
        """
        circle, top = circle_of(near), checked_number("top", top, 1)
        several = isinstance(pictures, Sequence) and not isinstance(pictures, str)
        listed: Sequence[Picture] = pictures if several else [pictures]  # type: ignore[assignment,list-item]
        frames = [pixels_of(picture) for picture in listed]
        if self._loaded is None or self._loaded.version != self.database.version:
            self._loaded = None  # its memory is needed
            self._loaded = LoadedMap(self.database, self._segmenter)
        answers = self._loaded.locate(frames, top, circle)
        return answers if several else answers[0]

    def tracker(
        self,
        steps: Steps | None = None,
        top: int = 5,
        near: Circle | None = None,
        channels: Sequence[str] | None = None,
    ) -> Tracker:
        """Localises a sequence while it comes: pictures or label maps, one by one. The map is
        loaded, and stays as it is; one without frames, or none in the circle, is a ValueError.
        ``follow`` of the steps must be online, with a ``delay`` of so many later frames that an
        answer waits for, by default none. Other arguments are as for `query`."""
        if not len(self):
            raise ValueError(f"{self.path} holds no frames yet")
        used, steps = chosen_channels(self.database, channels), steps or Steps(follow="online")
        network = partial(self._segmenter, used)
        return Tracker(self.database, used, network, self.labels_as, steps, top, circle_of(near))

    def track(
        self,
        frames: FrameSelection,
        names: Iterable[str],
        steps: Steps | None = None,
        top: int = 5,
        near: Circle | None = None,
        channels: Sequence[str] | None = None,
        note: Note = do_nothing,
    ) -> Iterator[Answer | Skipped]:
        """The answers to files whose ``names`` come one by one, and the files that could not be
        read; ``frames`` says how. Other arguments and errors as for `tracker`."""
        database, tracker = self.database, self.tracker(steps, top, near, channels)
        pictured = any(channel.lacks(None) for channel in tracker.channels)
        source = self.source(frames, compared=True, images=pictured, live=True, note=note)
        space = space_of_queries(database, source, tracker.channels)
        describer = Describer(tracker.channels, space, tracker.columns)
        described = encode_names(describer, names, frames.sequence, source.segmenter, database)
        return tracker.follow(described)

    def evaluate(
        self,
        frames: AnyFrames,
        steps: Steps | None = None,
        *,
        ground_truth: Path | None = None,
        tolerance_metres: float | None = None,
        tolerance_degrees: float | None = None,
        tolerance_frames: int | None = None,
        convention: Convention = "exact",
        note: Note = do_nothing,
        **settings: Any,
    ) -> Evaluation:
        """Measures how well frames are found: RecallRate@N, AUC-PR, Recall@100%Precision and more.
        Errors are those of `query`; that no true match is defined or known is a ValueError.

        Args:
            frames, steps, settings: as for `query`.
            ground_truth: a file of true matches, see ``ssrvlad evaluate --help``; by default that
                of the data set.
            tolerance_metres, tolerance_degrees, tolerance_frames: instead of it, the largest
                distance of a true match. By the poses, frames of unknown pose are left out.
            convention: of the metrics.
            note: gets what is left out.
        """
        source = self._source(frames)
        declared = source.dataset.truth if source.dataset else None
        tolerances = tolerance_metres, tolerance_degrees, tolerance_frames
        definition = GroundTruth.chosen(declared, ground_truth, *tolerances)
        circle = circle_of(settings.get("near"))
        settings["near"] = posed_references(definition, source, self.database, circle, note)
        answers = self.query(source, steps, TOP, **settings)
        material = Material.of(self.database, answers, source)
        return evaluate_answers(answers, material, definition, convention, note)

    def draw(self, answers: Answers, frames: Frames | SelectedFrames) -> Figure:
        """A figure of answers of `query` to frames: where they are in the map, and some beside
        their answers. It needs the extra ``eval`` (matplotlib)."""
        return draw_answers(answers, Material.of(self.database, answers, self._source(frames)))

    def _source(self, frames: AnyFrames) -> SelectedFrames:
        """The frames to be compared with the map, which must exist."""
        if isinstance(frames, SelectedFrames):
            return frames
        listed: Any = frames if isinstance(frames, Sequence) and not isinstance(frames, str) else ()
        if not listed or not all(isinstance(frame, np.ndarray | Image.Image) for frame in listed):
            return self.source(frames, compared=True)  # type: ignore[arg-type]
        arrays = [frame if isinstance(frame, np.ndarray) else pixels_of(frame) for frame in listed]
        pictured = any(array.ndim > 2 for array in arrays)
        source = self.source(_LIVE, compared=True, images=pictured, live=True)
        if source.segmenter and (shapes := [array.shape for array in arrays if array.ndim != 3]):
            raise ValueError(f"expected pictures (H, W, 3) for the network, got {shapes[0]}")
        self._opened = source.segmenter or self._opened
        files = [frame_in_memory(number, array) for number, array in enumerate(arrays)]
        return replace(source, files=files)

    def _segmenter(self, channels: Sequence[Channel]) -> Segmenter:
        """The network, or the one that made the map; one with which the channels of the map do not
        compare is a ValueError."""
        source = self.source(_LIVE, compared=True, images=True, live=True)
        assert source.segmenter
        require_network(self.database, source.segmenter)
        space_of_queries(self.database, source, channels)
        self._opened = source.segmenter
        return source.segmenter
