"""Tracker: where a sequence is in a known map, frame by frame."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
import torch

from ..channels.channel import Channel, View
from ..database.database import Database
from ..datasets.image_files import Picture, pixels_of
from ..datasets.label_files import LabelMap
from ..encoding.results import Encoded, Skipped
from ..files import parse_json, read_bytes, replacing
from ..native.map import Decision
from ..native.tracker import DescriptorTracker
from ..recognition.matching import checked_number
from ..recognition.recognise import Steps, score_is
from ..recognition.sequences import MIN_FRAMES
from ..recognition.sweep import COLUMNS
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace, label_space
from .answers import Answer, candidates_of
from .exact import map_of, views_of
from .selection import Near, Posed


class Tracker:
    """Localises a sequence while it comes; the map stays as it is. Made by `Map.tracker`.

    Attributes:
        channels, columns: by which frames are described, and from which anchors.

    Examples:
        >>> tracker = town.tracker()  # doctest: +SKIP
        >>> for picture in camera:  # doctest: +SKIP
        ...     answer = tracker.update(picture)
        ...     if answer.confidence >= 0.9:
        ...         print(answer.candidates[0].pose)
    """

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError("a Tracker cannot be copied or pickled: save and load it")

    def __init__(
        self,
        database: Database,
        channels: Sequence[Channel],
        open_segmenter: Callable[[], Segmenter],
        labels_as: str | LabelSpace | None,
        steps: Steps,
        top: int,
        near: Near | Posed | None,
    ) -> None:
        if steps.follow != "online":
            raise ValueError(f"follow: expected online, got {steps.follow}")
        self.channels, self.columns = tuple(channels), COLUMNS if steps.sweep else ()
        self._open_segmenter, self._references = open_segmenter, database.load()
        self._labels_as = label_space(labels_as or database.config.labels_as)
        top = min(checked_number("top", top, 1), len(self._references))
        where = near.rows(self._references.poses, database.path) if near else None
        allowed = None if where is None or where.all() else where
        self._tracker = DescriptorTracker(
            map_of(self._references, channels),
            steps.standardise, steps.sweep, steps.delay, top, allowed, torch.get_num_threads(),
        )  # fmt: skip
        self._waiting: dict[int, tuple[str, float | None]] = {}

    @cached_property
    def _segmenter(self) -> Segmenter:
        return self._open_segmenter()

    def update(
        self, frame: Picture | LabelMap | View, name: str | None = None, stamp: float | None = None
    ) -> Answer | None:
        """Takes the next frame, a picture, see `Map.locate`, a label map ``(H, W)`` of integers, or
        a `View` with what the channels need. ``name`` is what the answer calls it, by default the
        path of a file, else its number from 0; ``stamp`` is a time that the answer repeats.

        Returns the answer to it; with a delay that to the frame so many before, ``None`` if there
        is none yet. A missing file is a FileNotFoundError; what is no picture and no label map, and
        a label map where channels need pictures, are a ValueError, after which the tracker can go
        on."""
        if name is None:
            is_file = isinstance(frame, str | os.PathLike)
            name = os.fspath(frame) if is_file else str(self._tracker.count)  # type: ignore[arg-type]
        view = self._view(frame, name)
        described = {
            channel.column.name: channel.describe([view], self.columns)[0].numpy()
            for channel in self.channels
        }
        return self._take(described, name, stamp)

    def follow(self, frames: Iterable[Encoded | Skipped]) -> Iterator[Answer | Skipped]:
        """The answers to frames that are described by the channels and columns, each as soon as it
        is known, and the frames that could not be described."""
        for frame in frames:
            if isinstance(frame, Skipped):
                yield frame
            elif answer := self._take(frame.descriptors, frame.record.frame, frame.record.stamp):
                yield answer
        yield from self.finish()

    def finish(self) -> list[Answer]:
        """The answers to the frames that wait for later ones, by those that there are."""
        return [self._answer(*answer) for answer in self._tracker.finish()]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the state to a file, which another tracker of this map goes on from."""
        about = json.dumps([[number, *frame] for number, frame in self._waiting.items()])
        with replacing(Path(path)) as file:
            file.write_bytes(about.encode() + b"\n" + self._tracker.save())

    def load(self, path: str | os.PathLike[str]) -> None:
        """Goes on from a file that `save` wrote: answers are the same as if the sequence had not
        been interrupted. A state of another map or other settings, a damaged one, and a tracker
        that has taken a frame are a ValueError, a file that cannot be read is an OSError."""
        about, _, state = read_bytes(path, sys.maxsize).partition(b"\n")  # it has a digest
        try:
            waiting = {
                int(number): (str(name), None if stamp is None else float(stamp))
                for number, name, stamp in parse_json(about.decode(), "names of frames")
            }
            self._tracker.load(state)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: no state to go on from: {error}") from error
        self._waiting = waiting

    def _view(self, frame: Picture | LabelMap | View, name: str) -> View:
        if isinstance(frame, View):
            return frame
        if not (isinstance(frame, np.ndarray) and frame.ndim == 2):
            picture: Any = frame
            return views_of(self._segmenter, [pixels_of(picture)], [name], self.channels)[0]
        for channel in self.channels:
            if problem := channel.lacks(None):
                raise ValueError(f"{problem}, got a label map")
        return View(name, frame, self._labels_as)

    def _take(
        self, descriptors: Mapping[str, npt.NDArray[Any]], name: str, stamp: float | None
    ) -> Answer | None:
        self._waiting[self._tracker.count] = name, stamp
        answer = self._tracker.update(descriptors)
        return answer and self._answer(*answer)

    def _answer(self, number: int, decision: Decision) -> Answer:
        name, stamp = self._waiting[number]
        self._waiting = {key: frame for key, frame in self._waiting.items() if key > number}
        return Answer(
            name,
            candidates_of(self._references, decision.scores[0], decision.rows[0]),
            score_is(decision.followed, len(self.channels) > 1),
            float(decision.right[0]),
            stamp,
            number >= MIN_FRAMES,
        )
