"""The node without ROS: from label images or pictures to descriptors and loops."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from ssrvlad_torch import SSRVLAD, Database, Map
from ssrvlad_torch.channels import LABEL_SHAPES
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.datasets.image_files import require_photograph
from ssrvlad_torch.encoding.encoder import check_segmenter
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.result import LoopResult
from ssrvlad_torch.loops.stream import CHECKPOINT_FRAMES, open_detector
from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.search.answers import Answer
from ssrvlad_torch.search.exact import views_of
from ssrvlad_torch.search.tracker import Tracker
from ssrvlad_torch.taxonomy import LabelSpace, label_space

from .label_table import LABELS_AS, LabelTable
from .place_model import PlaceModel

DTYPES = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
"""Encodings of label images, and their dtypes."""
CHANNELS = {
    "rgb8": [0, 1, 2],
    "bgr8": [2, 1, 0],
    "rgba8": [0, 1, 2],
    "bgra8": [2, 1, 0],
    "mono8": [0, 0, 0],
}
"""Encodings of pictures, and their channels of red, green and blue."""

_OPENCV_FLOAT32 = 5
_DIGITS = 19
"""Of a stamp in nanoseconds that names a frame."""
_END = 2**31 * 10**9
"""The first time in nanoseconds that ``builtin_interfaces/Time`` cannot hold."""

GOLDEN = Path(__file__).with_name("golden.npz")
"""Label maps with their descriptors by the reference, by the fingerprint of a preset."""
TOLERANCE = 1e-6


class RosImage(Protocol):
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
        unsaved: why a checkpoint that was due could not be written; else empty.
        answer: where the tracker says that it is, or so many frames before; ``None`` without.
    """

    result: LoopResult
    descriptor: npt.NDArray[np.float32]
    unsaved: str = ""
    answer: Answer | None = None


class LiveLoops:
    """Finds loop closures in a stream of label images, or of pictures that a model labels.

    Its channels are all that the stream gives, or those of a memory that exists.

    Args:
        config: the settings of the detector.
        sequence: the name of this drive; frames are called ``<sequence>/<nanoseconds>``.
        meanings: see `LabelTable`.
        memory: database, a folder or URI, that stores the frames, created if it does not exist;
            without, none.
        preset: of the descriptors; without, the memory's, or ``default``.
        check: whether to run `check_head`.
        model: labels pictures; without, frames are label images.
        tracker: localises the stream in a known map, see `open_tracker`.

    Raises:
        ValueError: the memory is damaged, has another preset, other features or channels that the
            stream does not give; the model has other settings; or as for `check_head`.
    """

    def __init__(
        self,
        config: LoopConfig,
        sequence: str = "drive",
        meanings: Mapping[str, str] | None = None,
        memory: str | Path | None = None,
        preset: str | None = None,
        check: bool = True,
        model: PlaceModel | None = None,
        tracker: Tracker | None = None,
    ) -> None:
        self.sequence, self._model, self._tracker = sequence, model, tracker
        self._meanings = dict(meanings or {})
        names = channels_beside(memory, model)
        self._detector, self._database = open_detector(
            config, memory, preset, space_of(model), model, names
        )
        fingerprint = self._detector.head.config.fingerprint
        if model and model.fingerprint != fingerprint:
            raise ValueError(
                f"the model has settings {model.fingerprint}, this node {fingerprint}: expected "
                "the preset with which it was fused"
            )
        self._detector.segmenter = model
        if check:
            check_head(self._detector.head)
        self._saved = len(self._detector)
        self._table: LabelTable | None = None

    def set_labels(self, class_map: Iterable[tuple[int, str]]) -> None:
        """Sets the ids and names of the classes, as in ``vision_msgs/LabelInfo``.

        Raises:
            ValueError: as for `LabelTable`; the last table stays.
        """
        self._table = LabelTable(class_map, self._meanings)

    def update(
        self, image: RosImage, nanoseconds: int, pose: tuple[float, float, float] | None = None
    ) -> Observation:
        """Looks for the place of the next frame, then stores it.

        Args:
            image: ids of classes, its encoding one of `DTYPES`; with a model a picture, its
                encoding one of `CHANNELS`.
            nanoseconds: time at which it was taken.
            pose: x and y in metres, heading in radians.

        Raises:
            ValueError: there is no table of labels yet, the encoding is another, an id is unknown,
                the model fails, or the stamp goes back. Nothing is changed.
        """
        frame, stamp = f"{self.sequence}/{nanoseconds:0{_DIGITS}d}", nanoseconds / 1e9
        view = self._view(image, frame)
        result = self._detector.update(view.labels, frame, stamp, pose, view.picture, view.features)
        descriptor, unsaved = self._detector.descriptor, self._checkpoint()
        answer = self._tracker and self._tracker.update(view, frame, stamp)
        return Observation(result, descriptor, unsaved, answer)

    def _view(self, image: RosImage, frame: str) -> View:
        if self._model:
            channels = [
                *self._detector.channels,
                *(self._tracker.channels if self._tracker else ()),
            ]
            [view] = views_of(self._model, [decode_picture(image)], [frame], channels)
            return view
        if self._table is None:
            raise ValueError("no table of labels has come yet")
        return View(frame, self._table(decode(image)), space_of(None))

    def _checkpoint(self) -> str:
        """Saves if a checkpoint is due, and says what kept it from being written; the next try is
        the next checkpoint."""
        if len(self._detector) < self._saved + CHECKPOINT_FRAMES:
            return ""
        try:
            self.save()
        except (OSError, ValueError) as error:  # a ValueError if the memory cannot be read
            self._saved = len(self._detector)
            return str(error)
        return ""

    def save(self) -> None:
        """Writes a checkpoint to the memory; without a memory, does nothing.

        Raises:
            OSError: writing failed; the last checkpoint stays.
            ValueError: the memory cannot be read, or is not that of this stream any more.
        """
        if self._database is not None:
            self._detector.save(self._database)
        self._saved = len(self._detector)


def open_tracker(path: str | Path, model: PlaceModel | None, delay: int = 0) -> Tracker:
    """The tracker of a map of `ssrvlad encode` for the views of a stream; its answer to a frame
    waits for so many later ones.

    Raises:
        ValueError: there is no such map, or the stream does not give one of its channels.
    """
    town = Map.open(path)
    channels_beside(path, model)
    tracker = town.tracker(Steps(follow="online", delay=delay))
    head = SSRVLAD(replace(town.database.config, labels_as=space_of(model)))
    check_segmenter(model, head, tracker.channels)
    return tracker


def space_of(model: PlaceModel | None) -> LabelSpace:
    """The label space of the views of a stream."""
    return model.label_space if model else label_space(LABELS_AS)


def channels_beside(memory: str | Path | None, model: PlaceModel | None) -> list[str]:
    """Names of the channels beside that of label maps: those of a memory that exists, or all that
    the stream gives.

    Raises:
        ValueError: the stream does not give one of the memory.
    """
    channels = model.channels if model else []
    if memory is None or not Database.exists(memory):
        return channels
    names = [column.name for column in Database.open(memory).columns[1:]]
    if missing := [name for name in names if name not in channels]:
        raise ValueError(
            f"{memory} has {', '.join(missing)} of its frames, which this stream has not: it gives "
            f"{', '.join([LABEL_SHAPES, *channels])}"
        )
    return names


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
    same = SSRVLAD(replace(head.config, labels_as=LABELS_AS))
    difference = np.abs(same(labels).numpy() - expected).max()
    if not difference <= TOLERANCE:
        raise ValueError(
            f"descriptors are computed wrong on this machine: those of the golden label maps "
            f"differ by {difference:.2g}; expected at most {TOLERANCE}"
        )


def decode(image: RosImage) -> npt.NDArray[Any]:
    """``(H, W)`` uint8 or uint16 pixels of a label image, without the padding of its rows.

    Raises:
        ValueError: the encoding is another, or there is less data than the size requires.
    """
    return _pixels(image, _entry(image, DTYPES), 1)[..., 0]


def decode_picture(image: RosImage) -> npt.NDArray[np.uint8]:
    """``(H, W, 3)`` uint8 pixels of a picture in RGB; gray becomes three equal channels.

    Raises:
        ValueError: as for `decode`, or a gray picture looks like a label map.
    """
    channels = _entry(image, CHANNELS)
    gray = image.encoding == "mono8"
    pixels = _pixels(image, "u1", 1 if gray else len(image.encoding) - 1)
    if gray:
        require_photograph(pixels[..., 0])
    return pixels[..., channels]


def _entry(image: RosImage, encodings: Mapping[str, Any]) -> Any:
    """The entry of the encoding of an image."""
    if image.encoding not in encodings:
        raise ValueError(f"encoding {image.encoding!r}; expected one of {', '.join(encodings)}")
    return encodings[image.encoding]


def _pixels(image: RosImage, dtype: str, channels: int) -> npt.NDArray[Any]:
    """``(H, W, channels)`` of a dtype."""
    stored = np.dtype(dtype).newbyteorder(">" if image.is_bigendian else "<")
    row, content = image.width * channels * stored.itemsize, bytes(image.data)
    if image.step < row or len(content) < image.height * image.step or not image.height * row:
        raise ValueError(
            f"{len(content)} bytes in rows of {image.step}; expected {image.height} rows of {row}"
        )
    rows = np.frombuffer(content, np.uint8, image.height * image.step)
    pixels = rows.reshape(image.height, image.step)[:, :row].copy().view(stored)
    return pixels.reshape(image.height, -1, channels).astype(stored.newbyteorder("="))


def as_rtabmap(descriptor: npt.NDArray[np.float32]) -> bytes:
    """A descriptor as RTAB-Map compresses matrices (``rtabmap::compressData``): zlib, then rows,
    columns and OpenCV's type of float32 as 32-bit numbers."""
    content = zlib.compress(np.ascontiguousarray(descriptor, "<f4").tobytes())
    return content + np.array((1, len(descriptor), _OPENCV_FLOAT32), "<i4").tobytes()


def source_of(frame: str) -> tuple[str, int]:
    """The drive and the stamp in nanoseconds of a frame, by its id ``<drive>/<19 digits>``; of
    another, such as those of `ssrvlad encode`, the id and 0."""
    drive, _, name = frame.rpartition("/")
    is_stamp = len(name) == _DIGITS and name.isdecimal() and int(name) < _END
    return (drive, int(name)) if is_stamp else (frame, 0)


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
