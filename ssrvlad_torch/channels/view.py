"""View: what is known of a frame before it is described, filled by one pass of a network."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby, islice
from typing import Any

import numpy as np
import numpy.typing as npt

from ..datasets.names import sequence_of
from ..taxonomy import LabelSpace

LabelMap = npt.NDArray[np.integer[Any]]
Picture = npt.NDArray[np.uint8]


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
    picture: Picture | None = None
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


def picture_of(view: View, channel: str) -> Picture:
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
