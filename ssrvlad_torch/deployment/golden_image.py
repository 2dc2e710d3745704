"""The golden image: what a segmentation graph with an image input is run on."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from .model_file import one_line

BFLOAT16 = "tensor(bfloat16)"
"""A type of output that ONNX Runtime computes and cannot give to NumPy."""

_DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
_COLOURS = (3, 1, 4)
_SIZES = ((224, 448), (512, 512), (512, 1024), (1024, 2048))
"""Sizes for graphs that say they take any: one that patches of 14, 16 and 32 pixels divide, and
those that networks are often made for."""

_PATCHES = 40
_COLOUR_STEPS = 8


def run_on_golden_image(session: Any) -> tuple[npt.NDArray[Any], dict[str, Any]] | None:
    """An image that a graph can be run on, and all outputs for it by name.

    Args:
        session: of ONNX Runtime.

    Returns:
        the images, of the form of the graph's input, two if it takes any number; or ``None`` if
        its input is no image. Outputs in bfloat16 are left out: NumPy has no such numbers.

    Raises:
        ValueError: the graph fails on every size.
    """
    names = [output.name for output in session.get_outputs() if output.type != BFLOAT16]
    given, reason = session.get_inputs()[0].name, ""
    for images in _golden_images(session):
        try:
            outputs = session.run(names, {given: images}) if names else []
        except Exception as error:  # each kind of failure has its own type, not all of them public
            reason = f"fails on {images.shape} images: {one_line(error)}"
            continue
        return images, dict(zip(names, outputs, strict=True))
    if reason:
        raise ValueError(reason)
    return None


def _golden_images(session: Any) -> Iterator[npt.NDArray[Any]]:
    inputs = session.get_inputs()
    if len(inputs) != 1 or inputs[0].type not in _DTYPES or len(inputs[0].shape) != 4:
        return
    shape = [n if isinstance(n, int) and n > 0 else None for n in inputs[0].shape]
    channels_last = shape[1] not in _COLOURS and shape[3] in _COLOURS
    batch, *lengths = shape
    height, width, colours = lengths if channels_last else (*lengths[1:], lengths[0])
    if colours not in (None, *_COLOURS):
        return
    sizes = [(height, width)] if height and width else _SIZES
    for (rows, columns), count in product(sizes, [batch] if batch else (2, 1)):
        planes = (count, colours or _COLOURS[0], height or rows, width or columns)
        images = _patches(planes, inputs[0].type)
        yield np.ascontiguousarray(images.transpose(0, 2, 3, 1)) if channels_last else images


def _patches(shape: tuple[int, int, int, int], dtype: str) -> npt.NDArray[Any]:
    """``(B, C, H, W)``: every pixel has the colour of the nearest of some random points; 0 to 1,
    or 0 to 255 in bytes. Few colours, so that it compresses well."""
    _, colours, height, width = shape
    rng = np.random.default_rng(0)
    steps = np.empty(shape, np.int64)
    for image in steps:
        y, x = rng.uniform(0, height, _PATCHES), rng.uniform(0, width, _PATCHES)
        rows, columns = np.mgrid[:height, :width]
        nearest = np.zeros((height, width), np.int64)
        least = np.full((height, width), np.inf)
        for point in range(_PATCHES):
            distance = np.hypot(rows - y[point], columns - x[point])
            nearest[distance < least] = point
            least = np.minimum(least, distance)
        image[:] = rng.integers(0, _COLOUR_STEPS + 1, (colours, _PATCHES))[:, nearest]
    white = 255 if dtype == "tensor(uint8)" else 1
    return (steps * white / _COLOUR_STEPS).astype(_DTYPES[dtype])
