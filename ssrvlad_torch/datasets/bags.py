"""Images in ROS 1 and ROS 2 bags. Needs the extra ``rosbag``."""

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import check_pixels, npy_bytes, one_line, requiring
from .forward_reader import ForwardReader
from .frame_file import FrameFile
from .names import BAG_SUFFIXES, absolute

_MESSAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CHANNELS = {
    "rgb8": "rgb", "bgr8": "bgr", "rgba8": "rgba", "bgra8": "bgra", "mono8": "y", "mono16": "y"
}  # fmt: skip


@dataclass(frozen=True)
class BagFile(FrameFile):
    """One image of a topic of a bag; its ``row`` is the number of the message on the topic."""

    topic: str = ""

    @property
    def location(self) -> str:
        """Bag, topic and name, for messages."""
        return f"{self.path} {self.topic} at {self.name}"

    def _content(self) -> bytes:
        assert self.row is not None
        message = _open(self.path, self.topic, self.state).message(self.row)
        return message.data.tobytes() if hasattr(message, "format") else npy_bytes(_pixels(message))


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def bag_files(path: Path, topic: str | None = None) -> list[FrameFile]:
    """The images of one topic of a bag, by default the only one, in order of time; their sequence
    has no name yet. A frame is named by the time at which its message was recorded, in nanoseconds,
    and of equal times the later ones also by a number.
    A bag that cannot be read, no such topic, and several without a choice are a ValueError; without
    the extra ``rosbag``, an ImportError."""
    opened = _Topic(path, topic)
    name, folder = opened.connection.topic, absolute(path)
    files, times = list[FrameFile](), Counter[int]()
    with closing(opened.bag):
        for row, (time, _) in enumerate(opened.messages()):
            frame = f"{time}-{times[time]}" if time in times else str(time)
            times[time] += 1
            stamp = time * 1e-9
            files.append(BagFile("", frame, path, row, folder=folder, stamp=stamp, topic=name))
    return files


class _Topic:
    """The messages of one topic. Reading them in order reads the bag once."""

    def __init__(self, path: Path, topic: str | None) -> None:
        with requiring("rosbag", f"{path} needs"):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        try:
            # bags written before ROS 2 Iron do not hold the types of their messages
            self.bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self.bag.open()
        except Exception as error:  # damaged files raise any exception
            raise ValueError(f"{path} is not a readable bag: {one_line(error)}") from error
        by_topic = {c.topic: c for c in self.bag.connections if c.msgtype in _MESSAGE_TYPES}
        names = ", ".join(sorted(by_topic)) or "none"
        if topic is None and len(by_topic) != 1:
            raise ValueError(
                f"{path} has {len(by_topic)} topics of images, {names}; name one with --topic"
            )
        if topic is not None and topic not in by_topic:
            raise ValueError(f"{path} has no topic {topic} of images; it has {names}")
        self.connection = by_topic[topic or names]
        self._raw = ForwardReader(lambda _start: enumerate(raw for _, raw in self.messages()))

    def messages(self) -> Iterator[tuple[int, Any]]:
        """Time in nanoseconds and raw bytes of every message."""
        for _, time, raw in self.bag.messages(connections=[self.connection]):
            yield time, raw

    def message(self, row: int) -> Any:
        """A message by its number; a ValueError if the bag ends before it."""
        raw = self._raw.item(row)
        if raw is None:
            raise ValueError(f"the bag has no message {row} of the topic")
        return self.bag.deserialize(raw, self.connection.msgtype)


@lru_cache(maxsize=4)
def _open(path: Path, topic: str, state: str) -> _Topic:
    """A topic, opened again when the state of the file changes."""
    del state
    return _Topic(path, topic)


def _pixels(message: Any) -> npt.NDArray[np.uint8]:
    """Pixels ``(H, W, 3)`` uint8 of a raw image; an unknown encoding is a ValueError."""
    from .image_files import high_bytes  # it finds bags

    if message.encoding not in _CHANNELS:
        expected = ", ".join(_CHANNELS)
        raise ValueError(f"image encoding: got {message.encoding!r}, expected one of {expected}")
    check_pixels(message.height, message.width)
    order, is_wide = _CHANNELS[message.encoding], message.encoding == "mono16"
    used = message.width * len(order) * (2 if is_wide else 1)
    lines = np.ascontiguousarray(message.data.reshape(message.height, message.step)[:, :used])
    pixels = lines.reshape(message.height, message.width, -1)
    if is_wide:
        pixels = high_bytes(pixels.view(">u2" if message.is_bigendian else "<u2"))
    return np.ascontiguousarray(pixels[..., [max(order.find(colour), 0) for colour in "rgb"]])
