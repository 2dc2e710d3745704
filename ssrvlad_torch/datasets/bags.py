"""Pictures in ROS 1 and ROS 2 bags. Needs the extra ``rosbag``."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import one_line
from ..untrusted import check_pixels
from .frame_file import FrameFile
from .names import absolute

_SUFFIXES = (".bag", ".mcap", ".db3")
_KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CHANNELS = {
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2, None),
    "bgra8": (2, 1, 0, None),
    "mono8": (0,),
    "mono16": (0,),
}
"""Where red, green and blue stand in a pixel of each encoding; one place is that of a gray."""

_RECENT = 16


@dataclass(frozen=True)
class BagFile(FrameFile):
    """One picture of a bag; its ``row`` is the number of the message on the topic.

    Attributes:
        topic: name of the topic.
    """

    topic: str = ""

    @property
    def place(self) -> str:
        """Where it is, for messages."""
        return f"{self.path} {self.topic} at {self.name}"

    def _content(self) -> bytes:
        assert self.row is not None
        return _picture(_opened(self.path, self.topic, self.state).message(self.row))


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag, or the folder of one."""
    return path.suffix.lower() in _SUFFIXES or (path / "metadata.yaml").is_file()


def bag_files(path: Path, topic: str | None = None) -> list[FrameFile]:
    """The pictures of one topic of a bag, in order of time, of a sequence without a name. A frame
    is named by the time at which its message was recorded, in nanoseconds.

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, or the folder of a ROS 2 bag.
        topic: may be left out if only one has pictures.

    Raises:
        ValueError: it is no bag, or damaged; there is no such topic, or there are several.
        ImportError: the extra ``rosbag`` is not installed.
    """
    drive = _Topic(path, topic)
    folder = absolute(path if path.is_dir() else path.with_suffix(""))
    return [
        BagFile(
            "", str(time), path, row, folder=folder, stamp=time * 1e-9, topic=drive.connection.topic
        )
        for row, (time, _) in enumerate(drive.messages())
    ]


class _Topic:
    """The messages of one topic; read in order it keeps its place, so that none is read twice."""

    def __init__(self, path: Path, topic: str | None) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ImportError(f"{path} needs: pip install ssrvlad-torch[rosbag]") from error
        try:
            # bags before ROS 2 Iron do not say what their messages are
            self.bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self.bag.open()
        except Exception as error:  # what damaged bytes raise has no bounds
            raise ValueError(f"{path} is no bag that can be read: {one_line(error)}") from error
        self.connection = self._chosen(path, topic)
        self._lock = Lock()
        self._start()

    def messages(self) -> Iterator[tuple[int, Any]]:
        """Time in nanoseconds and bytes of every message."""
        for _, time, content in self.bag.messages(connections=[self.connection]):
            yield time, content

    def message(self, row: int) -> Any:
        """A message by its number; the last few messages are kept in memory."""
        with self._lock:
            if row < self._next and row not in self._recent:
                self._start()
            while row >= self._next:
                self._recent[self._next] = next(self._ahead)[1]
                self._recent.pop(self._next - _RECENT, None)
                self._next += 1
            return self.bag.deserialize(self._recent[row], self.connection.msgtype)

    def _start(self) -> None:
        self._next, self._ahead, self._recent = 0, self.messages(), dict[int, Any]()

    def _chosen(self, path: Path, topic: str | None) -> Any:
        pictures = {c.topic: c for c in self.bag.connections if c.msgtype in _KINDS}
        names = ", ".join(sorted(pictures)) or "none"
        if topic is None and len(pictures) != 1:
            raise ValueError(f"{path} has {len(pictures)} topics of pictures, {names}; name one "
                             "with --topic")  # fmt: skip
        if topic is not None and topic not in pictures:
            raise ValueError(f"{path} has no topic {topic} of pictures; it has {names}")
        return pictures[topic or names]


@lru_cache(maxsize=4)
def _opened(path: Path, topic: str, state: str) -> _Topic:
    """A topic that stays open, until the file changes."""
    del state
    return _Topic(path, topic)


def _picture(message: Any) -> bytes:
    """The picture of a message as an image file: compressed ones unchanged, raw ones as
    ``.npy``."""
    if hasattr(message, "format"):
        content: bytes = message.data.tobytes()
        return content
    file = io.BytesIO()
    np.lib.format.write_array(file, _pixels(message), allow_pickle=False)
    return file.getvalue()


def _pixels(message: Any) -> npt.NDArray[np.uint8]:
    """``(H, W, 3)`` uint8 of a raw image; another encoding or too few bytes are a ValueError."""
    if message.encoding not in _CHANNELS:
        expected = ", ".join(_CHANNELS)
        raise ValueError(f"pictures in {message.encoding!r} are not read; expected {expected}")
    check_pixels(message.height, message.width)
    order = _CHANNELS[message.encoding]
    wide = 2 if message.encoding == "mono16" else 1
    shape = message.height, message.width, len(order) * wide
    lines = message.data.reshape(message.height, message.step)[:, : shape[1] * shape[2]]
    pixels = lines.reshape(shape)
    if wide == 2:
        pixels = pixels[..., :1] if message.is_bigendian else pixels[..., 1:]
    colours = [channel for channel in order if channel is not None]
    return np.ascontiguousarray(np.broadcast_to(pixels[..., colours], (*shape[:2], 3)))
