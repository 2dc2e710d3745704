"""The protocol of a channel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..recognition.comparison import References
from .column import Column
from .view import View

if TYPE_CHECKING:
    from ..descriptor import SSRVLAD

LABELS, PICTURE, FEATURES = "labels", "images", "features"
"""What a channel may need of a view."""


class Network(Protocol):
    """What a channel asks of the network that labels the pictures."""

    @property
    def fingerprint_of_features(self) -> str:
        """Of the network's features, which views hold; a ValueError says why it has none."""

    @property
    def problem_of_features(self) -> str:
        """Why the network has no features, in one line; empty if it has."""


class Channel(Protocol):
    """Something that is known of every frame, as numbers that show where the frame was taken.

    Attributes:
        column: name, fingerprint, shape and dtype under which a database stores the descriptors;
            the name is also the key of the channel in fusion.
        needs: what a view must have: `LABELS`, `PICTURE`, `FEATURES`.
        trust: how much the channel counts in fusion before anything is known of a drive; label maps
            count 1.
        threads: the most threads that describe at the same time; 0 if only the caller's may, as on
            another device, ``None`` for any number.
    """

    needs: frozenset[str]
    trust: float

    @property
    def threads(self) -> int | None:
        """See above."""

    @property
    def column(self) -> Column:
        """See above."""

    @classmethod
    def lacks(cls, network: Network | None) -> str:
        """Why frames that the network labels, or label maps without one, do not have the channel;
        empty if they do."""

    @classmethod
    def make(cls, head: SSRVLAD, network: Network | None) -> Self:
        """The channel of frames that a network labels, or of label maps; ``head`` describes label
        maps. A ValueError if they do not have it."""

    @classmethod
    def of(cls, column: Column, head: SSRVLAD) -> Self:
        """The channel of stored descriptors."""

    def describe(self, views: Sequence[View], columns: Sequence[int] = ()) -> Tensor:
        """``(N, *shape)`` descriptors of views of one `View.kind`; of a channel that can sweep,
        from S anchors, the columns, ``(N, S, *shape)``, see `recognition.sweep`. A view that lacks
        what the channel needs, or cannot be described, is a ValueError."""

    def references(self, stored: Tensor, sequences: Sequence[str]) -> References:
        """Descriptors ``(R, *shape)`` of a map, to be compared with queries."""

    def live(self) -> Live:
        """The memory of a live stream, without frames."""


class Live(Protocol):
    """The descriptors of the frames of a live stream so far, in order, each compared without the
    mean of its own sequence."""

    def __len__(self) -> int: ...

    @property
    def empty(self) -> npt.NDArray[np.bool_]:
        """``(N,)``, the frames of which nothing is known; a view."""

    def checked(self, descriptor: Tensor, frame: str) -> npt.NDArray[Any]:
        """``(S, *shape)`` descriptors of a frame, from ``shape``, or from S anchors with the usual
        one in the middle; others are a ValueError that names the frame."""

    def scores(self, swept: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """``(N,)`` cosines of a new frame, `checked`, to all others; -inf for an empty one."""

    def add(self, descriptor: npt.NDArray[Any]) -> None:
        """Appends a frame by its descriptor from the usual anchor."""

    def extend(self, descriptors: Tensor) -> None:
        """Appends frames of the present sequence by their stored descriptors ``(N, *shape)``."""

    def start_sequence(self) -> None:
        """The next frame starts another sequence."""

    def descriptors(self, first: int, last: int) -> npt.NDArray[Any]:
        """``(last - first, *shape)``, a copy."""
