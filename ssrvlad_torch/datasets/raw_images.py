"""The pixels of raw images in ROS messages, by their encodings."""

from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import check_pixels

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
_BILINEAR = np.array([(1, 2, 1), (2, 4, 2), (1, 2, 1)]) / 4


def check_encoding(encoding: str) -> None:
    """Raises a ValueError for an encoding that is not read."""
    if encoding not in _CHANNELS:
        expected = ", ".join(_CHANNELS)
        raise ValueError(f"image encoding: got {encoding!r}, expected one of {expected}")


def raw_pixels(message: Any) -> Bytes:
    """Pixels ``(H, W, 3)`` uint8 in RGB of a ``sensor_msgs/Image``, of 16 bits the high 8; an
    encoding that is not read, and of gray what `high_bytes` refuses, are a ValueError."""
    from .image_files import high_bytes  # it finds bags

    check_encoding(message.encoding)
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
    colours = np.empty(mosaic.shape, "U1")
    for place, colour in enumerate(order):
        colours[place // 2 :: 2, place % 2 :: 2] = colour
    pixels = np.empty((*mosaic.shape, 3), np.uint8)
    for channel, colour in enumerate("rgb"):
        mask = colours == colour
        mean = _smoothed(mosaic * mask) / np.maximum(_smoothed(mask), 1e-9)
        pixels[..., channel] = np.where(mask, mosaic, mean.round())
    return pixels


def _smoothed(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    height, width = values.shape
    padded = np.pad(values.astype(float), 1)
    total = np.zeros(values.shape)
    for (down, right), weight in np.ndenumerate(_BILINEAR):
        total += weight * padded[down : down + height, right : right + width]
    return total
