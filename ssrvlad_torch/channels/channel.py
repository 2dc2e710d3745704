"""A channel, the views that it describes, and the channels of a database or of new frames."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby, islice
from typing import Literal, Protocol, Self

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..datasets.image_files import Pixels
from ..datasets.label_files import LabelMap
from ..datasets.names import sequence_of
from ..descriptor import SSRVLAD
from ..taxonomy import LabelSpace
from . import CHANNELS, LABEL_SHAPES, Column

LABELS, PICTURE, FEATURES = "labels", "images", "features"
"""What a channel may need of a view."""


@dataclass(frozen=True)
class View:
    """A frame, by its id ``<sequence>/<name>``. What no channel needs may be missing.

    Attributes:
        labels: ``(H, W)`` ids of a label space.
        labels_as: the label space.
        picture: ``(H, W, 3)`` uint8, RGB.
        features: signs of `stages.features.SHAPE`, uint8.
    """

    frame: str
    labels: LabelMap | None = None
    labels_as: str | LabelSpace | None = None
    picture: Pixels | None = None
    features: npt.NDArray[np.uint8] | None = None

    @property
    def sequence(self) -> str:
        """The part of the id before the last slash."""
        return sequence_of(self.frame)

    @property
    def kind(self) -> object:
        """What is equal in a batch: the sizes, the dtype of the label map, and its label space."""
        labels = None if self.labels is None else (self.labels.shape, self.labels.dtype)
        return labels, self.labels_as, None if self.picture is None else self.picture.shape


def picture_of(view: View, channel: str) -> Pixels:
    """The picture of a view. A missing one, or one that is not ``(H, W, 3)`` uint8, is a
    ValueError that names the channel."""
    if view.picture is None:
        raise ValueError(f"{channel} needs pictures, but frame {view.frame} has none")
    got = view.picture
    if got.ndim != 3 or got.shape[2] != 3 or got.dtype != np.uint8 or got.size == 0:
        raise ValueError(
            f"{channel}: the picture of frame {view.frame} must be (H, W, 3) uint8, "
            f"got {got.shape} {got.dtype}"
        )
    return got


def labels_of(view: View, channel: str) -> tuple[LabelMap, str | LabelSpace]:
    """The label map of a view and its label space. A missing one, or a label map that is not
    ``(H, W)`` integers, is a ValueError that names the channel."""
    if view.labels is None or view.labels_as is None:
        lacks = "a label map" if view.labels is None else "the label space of its label map"
        raise ValueError(f"{channel} needs labels, but frame {view.frame} lacks {lacks}")
    got = view.labels
    if got.ndim != 2 or got.dtype.kind not in "iu" or got.size == 0:
        raise ValueError(
            f"{channel}: the label map of frame {view.frame} must be (H, W) integers, "
            f"got {got.shape} {got.dtype}"
        )
    return got, view.labels_as


def batches(views: Iterable[View], size: int) -> Iterator[list[View]]:
    """The views in order, in lists of at most ``size`` of one `View.kind`."""
    for _, run in groupby(views, lambda view: view.kind):
        while batch := list(islice(run, size)):
            yield batch


class Network(Protocol):
    """What a channel asks of the network that labels the pictures."""

    @property
    def fingerprint_of_features(self) -> str:
        """Of the network's features, which views hold; a ValueError says why it has none."""

    @property
    def problem_of_features(self) -> str:
        """Why the network has no features, in one line; empty if it has."""


class Channel(ABC):
    """Something that is known of every frame, as numbers that show where the frame was taken. A
    subclass defines ``name``, ``shape`` and `describe`.

    Attributes:
        name: of the column, and the key of the channel in fusion.
        fingerprint: what makes the descriptors; others do not compare.
        shape, dtype: of a descriptor.
        needs: what a view must have: `LABELS`, `PICTURE`, `FEATURES`.
        trust: how much the channel counts in fusion before anything is known of a drive; label maps
            count 1.
        threads: the most threads that describe at the same time; 0 if only the caller's may, as on
            another device, ``None`` for any number.
    """

    name: str
    fingerprint: str = ""
    shape: tuple[int, ...]
    dtype: Literal["float32", "uint8"] = "float32"
    needs: frozenset[str] = frozenset({PICTURE})
    trust = 1.0
    threads: int | None = None

    @property
    def column(self) -> Column:
        """Under which a database stores the descriptors."""
        return Column(self.name, self.fingerprint, self.shape, self.dtype)

    @classmethod
    def lacks(cls, network: Network | None) -> str:
        """Why frames that the network labels, or label maps without one, do not have the channel;
        empty if they do."""
        if network is None and PICTURE in cls.needs:
            return f"{cls.name} describes pictures: expected images and a segmenter"
        return ""

    @classmethod
    def of(cls, _head: SSRVLAD, _fingerprint: str) -> Self:
        """The channel whose descriptors have a fingerprint; the head describes label maps."""
        return cls()

    @abstractmethod
    def describe(self, views: Sequence[View], columns: Sequence[int] = ()) -> Tensor:
        """``(N, *shape)`` descriptors of views of one `View.kind`; of a channel that can sweep,
        from S anchors, the columns, ``(N, S, *shape)``, see `recognition.sweep`. A view that lacks
        what the channel needs, or cannot be described, is a ValueError."""


def channels_of(columns: Sequence[Column], head: SSRVLAD) -> list[Channel]:
    """The channels whose descriptors are in columns of a database; ``head`` describes label maps. A
    column that no channel makes, or that this version makes otherwise, is a ValueError."""
    channels = []
    for column in columns:
        channel = _class(column.name).of(head, column.fingerprint)
        if channel.column != column:
            makes = channel.column.fingerprint
            if makes == column.fingerprint:
                makes = f"descriptors {channel.column.shape}, not {column.shape}"
            raise ValueError(
                f"stored descriptors by {column.name} are of {column.fingerprint}, this version "
                f"makes {makes}: encode the frames again"
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
    refuse_text(names)
    if names is None:
        names = [name for name in CHANNELS if not _class(name).lacks(network)]
    else:
        names = list(dict.fromkeys([LABEL_SHAPES, *names]))
    return [channel_of(_class(name), head, network) for name in names]


def channel_of(kind: type[Channel], head: SSRVLAD, network: Network | None) -> Channel:
    """The channel of a kind of frames that a network labels, or of label maps without one; a
    ValueError if they do not have it."""
    if problem := kind.lacks(network):
        raise ValueError(problem if network else f"{problem}, got label maps")
    if network is None or FEATURES not in kind.needs:
        return kind.of(head, "")
    return kind.of(head, network.fingerprint_of_features)


def refuse_text(names: Sequence[str] | None) -> None:
    """Raises a ValueError if the names of channels are one text, whose letters would be names."""
    if isinstance(names, str):
        raise ValueError(f"expected a list of channels, got the text {names!r}")


def _class(name: str) -> type[Channel]:
    entry = CHANNELS.get(name)
    if entry is None:
        raise ValueError(f"expected a channel, {', '.join(CHANNELS)}, got {name!r}")
    if not isinstance(entry, str):
        return entry
    module, _, class_name = entry.partition(".")
    channel: type[Channel] = getattr(import_module(f".{module}", __package__), class_name)
    return channel
