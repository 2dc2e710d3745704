"""The protocol of a place-recognition method: encode queries and references, score the pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from inspect import signature
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from ..channels.channel import View


class Method(Protocol):
    """A place-recognition method, and what it ``needs``: any of ``"labels"``, ``"images"`` and
    ``"weights"``. Encodings are tensors, or tuples and lists of them."""

    name: str
    needs: frozenset[str]

    def encode_query(self, frames: Iterable[View]) -> Any:
        """The encodings of Q queries, each independent of the others. A frame that lacks what
        the method needs or cannot be encoded is a ValueError."""

    def encode_reference(self, frames: Iterable[View]) -> Any:
        """The encodings of R references, those of a sequence in order; errors as for queries."""

    def scores(self, queries: Any, references: Any) -> Tensor:
        """``(Q, R)`` float32, at most 1, higher for more similar frames, ``-inf`` for no candidate.
        A row does not depend on the other rows. The memory in addition to the result is bounded."""


METHODS = {
    "ssr-vlad": ("channel_methods", "SSRVLADMethod"),
    "features": ("channel_methods", "EncoderFeatures"),
    "cohog": ("cohog", "CoHOG"),
    "netvlad": ("netvlad", "NetVLAD"),
    "region-vlad": ("region_vlad", "RegionVLAD"),
    "lost-x": ("lost_x", "LoSTX"),
    "label-grid": ("channel_methods", "LabelGrid"),
    "hog": ("channel_methods", "HOGMethod"),
    "tiny-image": ("channel_methods", "TinyImage"),
}
"""Methods by name: the module of this package and the class in it."""

STORED = (".h5", ".hdf5")
"""Suffixes of files of stored descriptors, whose name is that of a method."""


def make(name: str, **settings: Any) -> Method:
    """A method of `METHODS` with settings, or a file of stored descriptors; an unknown name or
    setting is a ValueError."""
    if name.endswith(STORED):
        module, class_name = "stored_descriptors", "StoredDescriptors"
        settings = {"file": name, **settings}
    elif name in METHODS:
        module, class_name = METHODS[name]
    else:
        expected = f"{', '.join(METHODS)}, or a file of stored descriptors (.h5)"
        raise ValueError(f"unknown method {name!r}; expected one of {expected}")
    method: type[Method] = getattr(import_module(f".{module}", __package__), class_name)
    try:
        signature(method).bind(**settings)
    except TypeError as error:
        raise ValueError(f"method {name}: {error}") from error
    return method(**settings)


def noting(
    frames: Iterable[View], sequences: list[str], done: Callable[[int], object] = lambda _: None
) -> Iterator[View]:
    """Yields the frames unchanged; appends the sequence of each first, and calls ``done`` with 1
    after each."""
    for frame in frames:
        sequences.append(frame.sequence)
        yield frame
        done(1)
