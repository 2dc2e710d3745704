"""Tracker: where a sequence is in a known map, frame by frame."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..channels.channel import Channel, View
from ..database.frames import FrameSet
from ..datasets.image_files import Picture
from ..datasets.label_files import LabelMap
from ..files import read_bytes, replacing
from ..native.map import Decision
from ..native.tracker import DescriptorTracker
from ..recognition.recognise import Steps
from ..recognition.standardise import MIN_FRAMES
from ..recognition.sweep import COLUMNS
from .answers import Answer, candidates_of
from .exact import map_of


class Tracker:
    """Localises a sequence while it comes; the map stays as it is. Made by `Map.tracker`.

    Attributes:
        channels, columns: by which frames are described, and from which anchors.

    Examples:
        >>> tracker = town.tracker()  # doctest: +SKIP
        >>> for picture in camera:  # doctest: +SKIP
        ...     answer = tracker.update(picture)
        ...     if answer.confidence > 0.9:
        ...         print(answer.candidates[0].pose)
    """

    def __init__(
        self,
        references: FrameSet,
        channels: Sequence[Channel],
        view_of: Callable[[Picture | LabelMap, str], View],
        steps: Steps,
        top: int,
        where: npt.NDArray[np.bool_],
        threads: int,
    ) -> None:
        self.channels, self.columns = tuple(channels), COLUMNS if steps.sweep else ()
        self._references, self._view_of = references, view_of
        allowed = None if where.all() else where
        self._tracker = DescriptorTracker(
            map_of(references, channels),
            steps.standardise, steps.sweep, steps.delay, top, allowed, threads,
        )  # fmt: skip
        self._count = 0
        self._waiting: dict[int, tuple[str, float | None]] = {}

    def update(
        self, frame: Picture | LabelMap, name: str | None = None, stamp: float | None = None
    ) -> Answer | None:
        """Takes the next frame.

        Args:
            frame: a picture, see `Map.locate`, or a label map ``(H, W)`` of integers.
            name: what the answer calls it; by default its number, from 0.
            stamp: a time that the answer repeats.

        Returns:
            The answer to it; with a delay that to the frame so many before, ``None`` if there is
            none yet.

        Raises:
            FileNotFoundError: a file does not exist.
            ValueError: it is no picture and no label map, or the channels of the map need a
                picture. The tracker can go on with the next frame.
        """
        view = self._view_of(frame, str(self._count) if name is None else name)
        described = {
            channel.column.name: channel.describe([view], self.columns)[0].numpy()
            for channel in self.channels
        }
        return self.take(described, view.frame, stamp)

    def take(
        self, descriptors: Mapping[str, npt.NDArray[Any]], name: str, stamp: float | None = None
    ) -> Answer | None:
        """As `update`, by the descriptors of a frame by the columns of the channels."""
        self._waiting[self._count] = name, stamp
        answer = self._tracker.update(descriptors)
        self._count += 1
        return answer and self._answer(*answer)

    def finish(self) -> list[Answer]:
        """The answers to the frames that wait for later ones, by those that there are."""
        return [self._answer(*answer) for answer in self._tracker.finish()]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the state to a file, which another tracker of this map goes on from."""
        with replacing(Path(path)) as file:
            file.write_bytes(self._tracker.save())

    def load(self, path: str | os.PathLike[str]) -> None:
        """Goes on from a file that `save` wrote; frames are numbered anew. Answers are the same as
        if the sequence had not been interrupted.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is of another map, or of other settings, or damaged; or this tracker has
                taken a frame.
        """
        try:
            self._tracker.load(read_bytes(path))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def _answer(self, number: int, decision: Decision) -> Answer:
        name, stamp = self._waiting.pop(number, (str(number), None))
        alone = "fused score" if len(self.channels) > 1 else "cosine"
        return Answer(
            name,
            candidates_of(self._references, decision.scores[0], decision.rows[0]),
            "probability" if decision.followed else alone,
            float(decision.right[0]),
            stamp,
            number >= MIN_FRAMES,
        )
