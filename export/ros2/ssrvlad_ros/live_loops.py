"""The node without ROS: from label images to descriptors and loops."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.result import LoopResult
from ssrvlad_torch.loops.stream import CHECKPOINT_FRAMES, open_detector

from .label_table import LABELS_AS, LabelTable

DTYPES = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
"""Encodings of label images, and their dtypes."""

_OPENCV_FLOAT32 = 5


GOLDEN = Path(__file__).with_name("golden.npz")
"""Label maps with their descriptors by the reference, by the fingerprint of a preset."""
TOLERANCE = 1e-6


class LabelImage(Protocol):
    """The fields of ``sensor_msgs/Image`` that are read."""

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Any


class Quaternion(NamedTuple):
    """A rotation, as ``geometry_msgs/Quaternion``."""

    x: float
    y: float
    z: float
    w: float


class Observation(NamedTuple):
    """The results for a frame.

    Attributes:
        result: whether it closes a loop.
        descriptor: ``(D,)`` float32.
    """

    result: LoopResult
    descriptor: npt.NDArray[np.float32]


class LiveLoops:
    """Finds loop closures in a stream of label images.

    Args:
        config: the settings of the detector.
        sequence: the name of this drive; frames are called ``<sequence>/<nanoseconds>``.
        meanings: see `LabelTable`.
        memory: database that stores the frames, created if it does not exist; without, none.
        preset: of the descriptors; without, the memory's, or ``default``.
        check: whether to run `check_head`.

    Raises:
        ValueError: the memory is damaged, has another preset or frames with other ids; or as for
            `check_head`.
    """

    def __init__(
        self,
        config: LoopConfig,
        sequence: str = "drive",
        meanings: Mapping[str, str] | None = None,
        memory: Path | None = None,
        preset: str | None = None,
        check: bool = True,
    ) -> None:
        self.sequence = sequence
        self._meanings = dict(meanings or {})
        self._detector, self._database = open_detector(config, memory, preset, LABELS_AS)
        if check:
            check_head(self._detector.head)
        for frame in self._detector.frames:
            nanoseconds_of(frame)
        self._saved = len(self._detector)
        self._table: LabelTable | None = None

    def set_labels(self, class_map: Iterable[tuple[int, str]]) -> None:
        """Sets the ids and names of the classes, as in ``vision_msgs/LabelInfo``.

        Raises:
            ValueError: as for `LabelTable`; the last table stays.
        """
        self._table = LabelTable(class_map, self._meanings)

    def update(
        self, image: LabelImage, nanoseconds: int, pose: tuple[float, float, float] | None = None
    ) -> Observation:
        """Looks for the place of the next frame, then stores it.

        Args:
            image: ids of classes; its encoding is one of `DTYPES`.
            nanoseconds: time at which it was taken.
            pose: x and y in metres, heading in radians.

        Raises:
            ValueError: there is no table of labels yet, the encoding is another, an id is unknown,
                or the stamp goes back. Nothing is changed.
        """
        if self._table is None:
            raise ValueError("no table of labels has come yet")
        labels = self._table(decode(image))
        frame = f"{self.sequence}/{nanoseconds:019d}"
        result = self._detector.update(labels, frame, nanoseconds / 1e9, pose)
        if len(self._detector) >= self._saved + CHECKPOINT_FRAMES:
            self.save()
        return Observation(result, self._detector.descriptor)

    def save(self) -> None:
        """Writes a checkpoint to the memory; without a memory, does nothing.

        Raises:
            OSError: writing failed; the last checkpoint stays.
        """
        if self._database is not None:
            self._detector.save(self._database)
        self._saved = len(self._detector)


def check_head(head: SSRVLAD) -> None:
    """Requires that this machine computes the recorded descriptors of the golden label maps.

    Nothing is recorded, and so nothing is checked, for custom settings.

    Raises:
        ValueError: a number differs by more than `TOLERANCE`.
    """
    fingerprint = head.config.fingerprint
    with np.load(GOLDEN) as recorded:
        if f"{fingerprint} labels" not in recorded:
            return
        labels, expected = (recorded[f"{fingerprint} {name}"] for name in ("labels", "descriptor"))
    difference = np.abs(head(labels).numpy() - expected).max()
    if not difference <= TOLERANCE:
        raise ValueError(
            f"descriptors are computed wrong on this machine: those of the golden label maps "
            f"differ by {difference:.2g}; expected at most {TOLERANCE}"
        )


def decode(image: LabelImage) -> npt.NDArray[Any]:
    """``(H, W)`` uint8 or uint16 pixels of an image, without the padding of its rows.

    Raises:
        ValueError: the encoding is another, or there is less data than the size requires.
    """
    if image.encoding not in DTYPES:
        raise ValueError(f"encoding {image.encoding!r}; expected one of {', '.join(DTYPES)}")
    stored = np.dtype(DTYPES[image.encoding]).newbyteorder(">" if image.is_bigendian else "<")
    row, content = image.width * stored.itemsize, bytes(image.data)
    if image.step < row or len(content) < image.height * image.step or not image.height * row:
        raise ValueError(
            f"{len(content)} bytes in rows of {image.step}; expected {image.height} rows of {row}"
        )
    rows = np.frombuffer(content, np.uint8, image.height * image.step)
    pixels = rows.reshape(image.height, image.step)[:, :row].copy().view(stored)
    return pixels.astype(stored.newbyteorder("="))


def as_rtabmap(descriptor: npt.NDArray[np.float32]) -> bytes:
    """A descriptor as RTAB-Map compresses matrices (``rtabmap::compressData``): zlib, then rows,
    columns and OpenCV's type of float32 as 32-bit numbers."""
    content = zlib.compress(np.ascontiguousarray(descriptor, "<f4").tobytes())
    return content + np.array((1, len(descriptor), _OPENCV_FLOAT32), "<i4").tobytes()


def nanoseconds_of(frame: str) -> tuple[str, int]:
    """The drive and the stamp in the id of a frame.

    Raises:
        ValueError: the id has another form.
    """
    drive, _, number = frame.rpartition("/")
    if not (drive and number.isdecimal()):
        raise ValueError(f"expected a frame <drive>/<nanoseconds>, got {frame!r}")
    return drive, int(number)


def heading(rotation: Quaternion) -> float:
    """The angle about the vertical axis in radians, counter-clockwise from x."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def meanings_of(words: Iterable[str]) -> dict[str, str]:
    """Categories by name, from words ``name=category``; empty words are skipped.

    Raises:
        ValueError: a word has another form.
    """
    meanings = {}
    for word in filter(None, words):
        name, equals, category = word.rpartition("=")
        if not (name and equals and category):
            raise ValueError(f"expected name=category, got {word!r}")
        meanings[name] = category
    return meanings
