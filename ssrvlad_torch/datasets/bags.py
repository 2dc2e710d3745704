"""Images in ROS 1 and ROS 2 bags. Needs the extra ``rosbag``."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..files import npy_bytes, one_line, requiring
from .forward_reader import ForwardReader
from .frame_file import FrameFile
from .names import BAG_SUFFIXES, absolute
from .raw_images import check_encoding, raw_pixels

_MESSAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FILMS = ("compresseddepth", "h264", "h265", "hevc", "av1", "ffmpeg", "theora")
"""In the format of a compressed image, what is no picture that stands alone."""


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
        return (
            message.data.tobytes() if hasattr(message, "format") else npy_bytes(raw_pixels(message))
        )


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def bag_files(
    path: Path, topic: str | None = None, note: Callable[[str], object] = lambda _: None
) -> list[FrameFile]:
    """The images of one topic of a bag, by default the only one that can be read, in order of time;
    their sequence has no name yet. A frame is named by the time at which its message was recorded,
    in nanoseconds, and of equal times the later ones also by a number. ``note`` gets a line for
    each topic of images that cannot be read.
    A bag that cannot be read, no such topic, and several without a choice are a ValueError; without
    the extra ``rosbag``, an ImportError."""
    opened = _Topic(path, topic, note)
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

    def __init__(
        self, path: Path, topic: str | None, note: Callable[[str], object] = lambda _: None
    ) -> None:
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
        if topic is not None and topic not in by_topic:
            topics = ", ".join(sorted(by_topic)) or "none"
            raise ValueError(f"{path} has no topic {topic} of images; it has {topics}")
        problems = {name: self._problem(c) for name, c in by_topic.items() if topic in (None, name)}
        unread = [f"{path} {name}: {problem}" for name, problem in problems.items() if problem]
        names = sorted(name for name in problems if not problems[name])
        if unread and not names:
            raise ValueError("; ".join(unread))
        if len(names) != 1:
            raise ValueError(
                f"{path} has {len(names)} topics of images, {', '.join(names) or 'none'}; "
                "name one with --topic"
            )
        for line in unread:
            note(f"{line}; the topic is passed over")
        self.connection = by_topic[names[0]]
        self._raw = ForwardReader(lambda _start: enumerate(raw for _, raw in self.messages()))

    def _problem(self, connection: Any) -> str:
        """Why the images of a topic cannot be read, by its first message; empty if they can."""
        try:
            _, _, raw = next(self.bag.messages(connections=[connection]))
            message = self.bag.deserialize(raw, connection.msgtype)
        except Exception:  # damaged messages raise any exception; each is skipped when it is read
            return ""
        form = getattr(message, "format", "")
        if any(film in form.lower() for film in _FILMS):
            return f"compressed images: got {form!r}, expected JPEG or PNG"
        try:
            check_encoding(getattr(message, "encoding", "rgb8"))
        except ValueError as error:
            return str(error)
        return ""

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
