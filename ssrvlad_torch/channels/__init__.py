"""Channels: what recognition compares of a frame. A channel describes views and compares them.

A channel is one file and one line of `CHANNELS`. The classes are imported at their first use.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..descriptor import SSRVLAD
    from .channel import Channel, Network
    from .column import Column

CHANNELS: dict[str, str | type[Channel]] = {
    "ssr-vlad": "label_shapes.LabelShapes",
    "features": "features.Features",
    "hog": "hog.HOG",
}
"""The class of each channel by its name; the first describes label maps, and every database of
frames has it."""

LABEL_SHAPES = next(iter(CHANNELS))


def channels_of(columns: Sequence[Column], head: SSRVLAD) -> list[Channel]:
    """The channels whose descriptors are in columns of a database; ``head`` describes label maps. A
    column that no channel makes, or that this version makes otherwise, is a ValueError."""
    channels = []
    for column in columns:
        channel = _class(column.name).of(column, head)
        if channel.column != column:
            raise ValueError(
                f"stored descriptors by {column.name} are of {column.fingerprint}, this version "
                f"makes {channel.column.fingerprint}: encode the frames again"
            )
        channels.append(channel)
    return channels


def new_channels(
    names: Sequence[str] | None, head: SSRVLAD, network: Network | None
) -> list[Channel]:
    """The channels of frames that a network labels, or of label maps without one: that of the label
    maps, and those with these names. Without names, all that the frames have: without a network
    none of pictures, and no features of a network that has none. An unknown name, and a channel
    that the frames do not have, are a ValueError."""
    if isinstance(names, str):
        raise ValueError(f"expected a list of channels, got the text {names!r}")
    if names is None:
        wanted = [name for name in CHANNELS if not _class(name).lacks(network)]
    else:
        wanted = list(dict.fromkeys([LABEL_SHAPES, *names]))
    return [_class(name).make(head, network) for name in wanted]


def _class(name: str) -> type[Channel]:
    entry = CHANNELS.get(name)
    if entry is None:
        raise ValueError(f"expected a channel, {', '.join(CHANNELS)}, got {name!r}")
    if not isinstance(entry, str):
        return entry
    module, _, class_name = entry.partition(".")
    channel: type[Channel] = getattr(import_module(f".{module}", __name__), class_name)
    return channel
