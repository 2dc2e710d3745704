"""Images inside the page: ``data:`` URIs of PNG and JPEG files."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from ..outcomes import Bools

MOST_PIXELS_WIDE = 400
_JPEG_QUALITY = 80
DARKEST, LIGHTEST = (13, 17, 26), (250, 250, 247)
"""Colours of the lowest and the highest score."""

_ABSENT = (70, 70, 74)

Pixels = npt.NDArray[np.uint8]
"""``(H, W, 3)`` RGB."""


def label_uri(picture: Pixels) -> str:
    """A label map in colours as a PNG, at most `MOST_PIXELS_WIDE` wide; reducing averages pixels,
    so that thin poles remain visible."""
    return _data_uri(_reduced(Image.fromarray(picture)), "png", optimize=True)


def photo_uri(picture: Pixels) -> str:
    """A photo as a JPEG, at most `MOST_PIXELS_WIDE` wide."""
    return _data_uri(_reduced(Image.fromarray(picture)), "jpeg", quality=_JPEG_QUALITY)


def scores_uri(scores: npt.NDArray[np.float32]) -> str:
    """Scores ``(h, w)`` as a PNG from dark, the lowest, to light, the highest; -inf has the colour
    `_ABSENT`."""
    finite = np.isfinite(scores)
    low, high = score_range(scores)
    fractions = (np.where(finite, scores, low) - low) / max(high - low, 1e-12)
    index = np.where(finite, 1 + np.round(fractions * 254), 0).astype(np.uint8)
    ramp = np.linspace(DARKEST, LIGHTEST, 255).round().astype(np.uint8)
    return _indexed(index, np.concatenate((np.array([_ABSENT], np.uint8), ramp)))


def score_range(scores: npt.NDArray[np.float32]) -> tuple[float, float]:
    """The lowest and the highest finite score; 0 and 1 without a finite score."""
    finite = scores[np.isfinite(scores)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)


def mask_uri(masks: list[tuple[Bools, tuple[int, int, int]]]) -> str:
    """Masks ``(h, w)`` with their colours as a PNG that is transparent elsewhere; later masks cover
    earlier ones."""
    index = np.zeros(masks[0][0].shape, np.uint8)
    for number, (mask, _) in enumerate(masks, start=1):
        index[mask] = number
    colours = np.array([(0, 0, 0), *(colour for _, colour in masks)], np.uint8)
    return _indexed(index, colours, transparency=0)


def _indexed(index: npt.NDArray[np.uint8], colours: Pixels, **options: Any) -> str:
    image = Image.fromarray(index)
    image.putpalette(colours.tobytes())
    return _data_uri(image, "png", optimize=True, **options)


def _reduced(image: Image.Image) -> Image.Image:
    if image.width <= MOST_PIXELS_WIDE:
        return image
    height = max(1, round(image.height * MOST_PIXELS_WIDE / image.width))
    return image.resize((MOST_PIXELS_WIDE, height), Image.Resampling.BOX)


def _data_uri(image: Image.Image, file_format: str, **options: Any) -> str:
    content = io.BytesIO()
    image.save(content, file_format, **options)
    return f"data:image/{file_format};base64,{base64.b64encode(content.getvalue()).decode()}"
