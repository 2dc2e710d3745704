"""Images in ROS 1 and ROS 2 bags, and the pixels of raw ones. Needs the extra ``rosbag``."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import check_pixels, npy_bytes, one_line, requiring
from .frame_file import FrameFile
from .names import BAG_SUFFIXES, absolute
from .reading import ForwardReader

_MESSAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_FILMS = ("compresseddepth", "h264", "h265", "hevc", "av1", "ffmpeg", "theora")
"""In the format of a compressed image, what is no picture that stands alone."""


def _image(topic: str, file: FrameFile) -> bytes:
    assert file.row is not None
    bag, connection, messages = _open(file.path, topic, file.state)
    if (raw := messages.item(file.row)) is None:
        raise ValueError(f"the bag has no message {file.row} of the topic")
    message = bag.deserialize(raw, connection.msgtype)
    is_file = hasattr(message, "format")
    return message.data.tobytes() if is_file else npy_bytes(raw_pixels(message))


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def bag_files(
    path: Path, topic: str | None = None, note: Callable[[str], object] = lambda _: None
) -> list[FrameFile]:
    """The images of one topic of a bag, by default the only one that can be read, by time, without
    the name of a sequence. A frame is named by its time of recording in nanoseconds, a later one of
    that time also by a number. ``note`` gets topics that cannot be read. No such topic, several,
    and a damaged bag are a ValueError; no extra ``rosbag``, an ImportError."""
    bag, folder = _opened(path), absolute(path)
    files, times = list[FrameFile](), Counter[int]()
    with closing(bag):
        connection = _chosen(path, bag, topic, note)
        for row, (_, time, _) in enumerate(bag.messages(connections=[connection])):
            name = f"{time}-{times[time]}" if time in times else str(time)
            times[time] += 1
            place, read = f"{path} {connection.topic} at {name}", partial(_image, connection.topic)
            file = FrameFile("", name, path, row, folder=folder, place=place, content=read)
            files.append(replace(file, stamp=time * 1e-9))
    return files


def _opened(path: Path) -> Any:
    with requiring("rosbag", f"{path} needs"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    try:
        # bags written before ROS 2 Iron do not hold the types of their messages
        bag = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        bag.open()
    except Exception as error:  # damaged files raise any exception
        raise ValueError(f"{path} is not a readable bag: {one_line(error)}") from error
    return bag


@lru_cache(maxsize=4)
def _open(path: Path, topic: str, _state: str) -> tuple[Any, Any, ForwardReader[bytes]]:
    """A bag, a topic of images and its messages by their numbers, opened again when the state of
    the file changes. Reading messages in order reads the bag once."""
    bag = _opened(path)
    connection = _chosen(path, bag, topic, lambda _: None)

    def raw(_start: int | None) -> Iterator[tuple[float, bytes]]:
        return enumerate(raw for _, _, raw in bag.messages(connections=[connection]))

    return bag, connection, ForwardReader(raw)


def _chosen(path: Path, bag: Any, topic: str | None, note: Callable[[str], object]) -> Any:
    """The topic of this name, or the only one that can be read; see `bag_files`."""
    by_topic = {c.topic: c for c in bag.connections if c.msgtype in _MESSAGE_TYPES}
    if topic is not None and topic not in by_topic:
        topics = ", ".join(sorted(by_topic)) or "none"
        raise ValueError(f"{path} has no topic {topic} of images; it has {topics}")
    problems = {name: _problem(bag, c) for name, c in by_topic.items() if topic in (None, name)}
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
    return by_topic[names[0]]


def _problem(bag: Any, connection: Any) -> str:
    """Why the images of a topic cannot be read, by its first message; empty if they can."""
    try:
        _, _, raw = next(bag.messages(connections=[connection]))
        message = bag.deserialize(raw, connection.msgtype)
    except Exception:  # damaged messages raise any exception; each is skipped when it is read
        return ""
    form, encoding = getattr(message, "format", ""), getattr(message, "encoding", "rgb8")
    if any(film in form.lower() for film in _FILMS):
        return f"compressed images: got {form!r}, expected JPEG or PNG"
    return "" if encoding in _CHANNELS else _unknown(encoding)


Bytes = npt.NDArray[np.uint8]

_CHANNELS = {
    "rgb8": "rgb", "bgr8": "bgr", "rgba8": "rgba", "bgra8": "bgra", "mono8": "y",
    "rgb16": "rgb", "bgr16": "bgr", "rgba16": "rgba", "bgra16": "bgra", "mono16": "y",
    "8UC1": "y", "8UC3": "bgr", "8UC4": "bgra",
    "yuv422": "uyvy", "uyvy": "uyvy", "yuv422_yuy2": "yuyv", "yuyv": "yuyv",
} | {f"bayer_{p}{n}": p for p in ("rggb", "bggr", "gbrg", "grbg") for n in (8, 16)}  # fmt: skip
"""The channels of a pixel, of two pixels of YUV, or of a square of 2 x 2 pixels of a Bayer pattern.
OpenCV's own names are read as RViz reads them."""
_YUV_TO_RGB = np.array([(1.164, 1.164, 1.164), (0, -0.392, 2.017), (1.596, -0.813, 0)])
"""ITU-R BT.601, of Y from 16 to 235."""
_BAYER = {"rggb": "BG", "grbg": "GB", "bggr": "RG", "gbrg": "GR"}
"""Kornia's names of Bayer patterns."""


def _unknown(encoding: str) -> str:
    return f"image encoding: got {encoding!r}, expected one of {', '.join(_CHANNELS)}"


def raw_pixels(message: Any) -> Bytes:
    """Pixels ``(H, W, 3)`` uint8 in RGB of a ``sensor_msgs/Image``, of 16 bits the high 8; an
    encoding that is not read, and of gray what `high_bytes` refuses, are a ValueError."""
    from .image_files import high_bytes  # it finds bags

    if message.encoding not in _CHANNELS:
        raise ValueError(_unknown(message.encoding))
    check_pixels(message.height, message.width)
    order, is_wide = _CHANNELS[message.encoding], message.encoding.endswith("16")
    is_bayer, is_yuv = message.encoding.startswith("bayer"), order in ("uyvy", "yuyv")
    samples = message.width * (1 if is_bayer else 2 if is_yuv else len(order))
    lines = message.data.reshape(message.height, message.step)[:, : samples * (1 + is_wide)]
    pixels = np.ascontiguousarray(lines)
    if is_wide:
        pixels = high_bytes(pixels.view(">u2" if message.is_bigendian else "<u2"))
    if is_bayer:
        return _of_bayer(pixels, order)
    if is_yuv:
        return _of_yuv(pixels.reshape(message.height, -1, 4), order)
    pixels = pixels.reshape(message.height, message.width, -1)
    return np.ascontiguousarray(pixels[..., [max(order.find(colour), 0) for colour in "rgb"]])


def _of_yuv(pairs: Bytes, order: str) -> Bytes:
    """Pairs of pixels ``(H, W / 2, 4)`` that share u and v."""
    first = order.index("y")
    luma = pairs[..., first::2].reshape(len(pairs), -1)
    u, v = (pairs[..., order.index(name)].repeat(2, axis=1) for name in "uv")
    pixels = np.stack([luma, u, v], -1).astype(float) - (16, 128, 128)
    colours: Bytes = (pixels @ _YUV_TO_RGB).round().clip(0, 255).astype(np.uint8)
    return colours


def _of_bayer(mosaic: Bytes, order: str) -> Bytes:
    """Pixels of one colour each; the two others are means of the neighbours that have them."""
    import torch
    from kornia.color import CFA, raw_to_rgb

    pixels = raw_to_rgb(torch.tensor(mosaic)[None].float(), CFA[_BAYER[order]])
    return pixels.round().byte().permute(1, 2, 0).numpy()
