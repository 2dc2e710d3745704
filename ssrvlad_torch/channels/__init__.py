"""Channels: what recognition compares of a frame. A channel describes views and compares them.

A channel is one file and one line of `CHANNELS`; its class is imported at its first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .channel import Channel

CHANNELS: dict[str, str | type[Channel]] = {
    "ssr-vlad": "label_shapes.LabelShapes",
    "features": "features.Features",
    "hog": "hog.HOG",
}
"""The class of each channel by its name; the first describes label maps, and every database of
frames has it."""

LABEL_SHAPES = next(iter(CHANNELS))
