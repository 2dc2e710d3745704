"""Channels: what recognition compares of a frame. A channel describes views and compares them.

A channel is one file and one line of `CHANNELS`; its class is imported at its first use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

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


class Column(NamedTuple):
    """The column of a database that holds the descriptors of a channel: their shape and dtype,
    ``"float32"``, or ``"uint8"`` for signs, eight in a byte. Descriptors are comparable only if
    their fingerprints are equal; empty if they are custom."""

    name: str
    fingerprint: str
    shape: tuple[int, ...]
    dtype: Literal["float32", "uint8"] = "float32"
