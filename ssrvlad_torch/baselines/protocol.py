"""The protocol of a place-recognition method: encode queries and references, score the pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from itertools import groupby, islice
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

LabelMap = npt.NDArray[np.integer[Any]]
Image = npt.NDArray[np.uint8]
Item = TypeVar("Item")


@dataclass(frozen=True)
class Frame:
    """One frame, the input of a method, by its id ``<sequence>/<name>``: label ids ``(H, W)`` and
    their label space, and the image ``(H, W, 3)`` uint8, RGB. What the method does not need may be
    missing."""

    frame: str
    labels: LabelMap | None = None
    labels_as: str | None = None
    image: Image | None = None

    @property
    def sequence(self) -> str:
        """The part of the id before the last slash."""
        return self.frame.rpartition("/")[0]


class Columns:
    """A base for frozen dataclasses of encodings whose fields are tensors with one row per frame,
    or lists with one tensor per frame."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, part: slice, /) -> Self:
        return type(self)(*(field[part] for field in vars(self).values()))

    @property
    def nbytes(self) -> int:
        """Bytes of all fields."""
        fields = vars(self).values()
        lists = (field if isinstance(field, list) else [field] for field in fields)
        return sum(tensor.nbytes for tensors in lists for tensor in tensors)


class Method(Protocol):
    """A place-recognition method.

    Queries and references may be encoded differently: SSR-VLAD sums references over their
    neighbours, CoHOG chooses regions of queries only. Encodings are usually a tensor with one row
    per frame; what is not has a length, slices and ``nbytes`` as well.

    Attributes:
        name: its name in `METHODS`.
        needs: any of ``"labels"``, ``"images"`` and ``"weights"``; nothing if descriptors are
            stored.
    """

    name: str
    needs: frozenset[str]

    def encode_query(self, frames: Iterable[Frame]) -> Any:
        """The encodings of Q queries, each independent of the others. A frame that lacks what the
        method needs, or cannot be encoded, is a ValueError."""

    def encode_reference(self, frames: Iterable[Frame]) -> Any:
        """The encodings of R references, those of a sequence in order; errors as for queries."""

    def scores(self, queries: Any, references: Any) -> Tensor:
        """``(Q, R)`` float32, at most 1, higher for more similar frames, ``-inf`` for no candidate.
        A row does not depend on the other rows. The memory in addition to the result is bounded."""


METHODS = {
    "ssr-vlad": ("ssrvlad", "SSRVLADMethod"),
    "features": ("encoder_features", "EncoderFeatures"),
    "cohog": ("cohog", "CoHOG"),
    "netvlad": ("netvlad", "NetVLAD"),
    "region-vlad": ("region_vlad", "RegionVLAD"),
    "lost-x": ("lost_x", "LoSTX"),
    "label-grid": ("label_grid", "LabelGrid"),
    "hog": ("hog", "HOG"),
    "tiny-image": ("tiny_image", "TinyImage"),
}
"""Methods by name: the module of this package and the class in it."""

STORED = (".h5", ".hdf5")
"""Suffixes of files of stored descriptors, whose name is that of a method."""


def make(name: str, **settings: Any) -> Method:
    """A method of `METHODS` with settings, or a file of stored descriptors; an unknown name or
    setting is a ValueError."""
    known = METHODS
    if name.endswith(STORED):
        known, settings = (
            {name: ("stored_descriptors", "StoredDescriptors")},
            {"file": name, **settings},
        )
    elif name not in METHODS:
        known_names = f"{', '.join(METHODS)}, or a file of stored descriptors (.h5)"
        raise ValueError(f"unknown method {name!r}; expected one of {known_names}")
    module, class_name = known[name]  # imported here, not earlier
    method: type[Method] = getattr(import_module(f".{module}", __package__), class_name)
    try:
        signature(method).bind(**settings)
    except TypeError as error:
        raise ValueError(f"method {name}: {error}") from error
    return method(**settings)


def image_of(frame: Frame, method: str) -> Image:
    """The image of a frame, for a method. A missing one, or an image that is not ``(H, W, 3)``
    uint8, is a ValueError."""
    if frame.image is None:
        raise ValueError(f"method {method} needs images, but frame {frame.frame} has none")
    got = frame.image
    if got.ndim != 3 or got.shape[2] != 3 or got.dtype != np.uint8 or got.size == 0:
        raise ValueError(
            f"method {method}: the image of frame {frame.frame} must be (H, W, 3) uint8, "
            f"got {got.shape} {got.dtype}"
        )
    return got


def labels_of(frame: Frame, method: str) -> tuple[LabelMap, str]:
    """The label map of a frame and its label space, for a method. A missing one, or a label map
    that is not ``(H, W)`` integers, is a ValueError."""
    if frame.labels is None or frame.labels_as is None:
        lacks = "a label map" if frame.labels is None else "the label space of its label map"
        raise ValueError(f"method {method} needs labels, but frame {frame.frame} lacks {lacks}")
    got = frame.labels
    if got.ndim != 2 or got.dtype.kind not in "iu" or got.size == 0:
        raise ValueError(
            f"method {method}: the label map of frame {frame.frame} must be (H, W) integers, "
            f"got {got.shape} {got.dtype}"
        )
    return got, frame.labels_as


def label_kind(frame: Frame) -> object:
    """What is equal in a batch of label maps: shape, dtype and label space."""
    labels = frame.labels
    return None if labels is None else (labels.shape, labels.dtype, frame.labels_as)


def image_shape(frame: Frame) -> object:
    """What is equal in a batch of images."""
    return None if frame.image is None else frame.image.shape


def noting(
    frames: Iterable[Frame], sequences: list[str], done: Callable[[int], object] = lambda _: None
) -> Iterator[Frame]:
    """Yields the frames unchanged; appends the sequence of each first, and calls ``done`` with 1
    after each."""
    for frame in frames:
        sequences.append(frame.sequence)
        yield frame
        done(1)


def batches(
    frames: Iterable[Item], size: int, kind: Callable[[Item], object] | None = None
) -> Iterator[list[Item]]:
    """The frames in order, in lists of at most ``size`` with equal values of ``kind``."""
    for _, run in groupby(frames, kind or (lambda _: None)):
        while batch := list(islice(run, size)):
            yield batch
