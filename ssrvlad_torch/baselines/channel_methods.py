"""Methods that are channels: SSR-VLAD, features, HOG, and the label grid, the trivial one."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import LABELS, PICTURE, VectorChannel, View, batches, labels_of, picture_of
from ..channels.features import Features
from ..channels.hog import HOG
from ..channels.label_shapes import LabelShapes
from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..recognition.recognise import references_of
from ..recognition.sweep import COLUMNS, score
from ..recognition.temporal import temporal_sum
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..stages.layers import UNKNOWN, categorise, category_table, refuse_unknown
from ..taxonomy import CATEGORIES, LabelSpace, label_space
from .protocol import noting


class VectorMethod(VectorChannel):
    """A channel of vectors as a method: of length 1, or zero for an empty frame. Queries and
    references are described alike, in batches."""

    batch = 16

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, *shape)``."""
        return joined(map(self.describe, batches(frames, self.batch)), self.name)

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, *shape)``, encoded as queries are."""
        return self.encode_query(frames)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines."""
        return score(queries, references)


def joined(batches: Iterable[Tensor], method: str) -> Tensor:
    """The encodings of batches, one after another; none is a ValueError."""
    if encodings := list(batches):
        return torch.cat(encodings)
    raise ValueError(f"method {method}: no frames to encode")


class HOGMethod(VectorMethod, HOG):
    """HOG as a method."""


class SSRVLADMethod(VectorMethod, LabelShapes):
    """Raw descriptors of queries, which may have different label spaces, against references summed
    over ``temporal`` frames on each side inside a sequence (t of Eq. 3); ``settings`` are fields of
    `SSRVLADConfig` that replace those of the preset."""

    def __init__(self, preset: str = "default", temporal: int = 0, **settings: Any) -> None:
        if temporal < 0:
            raise ValueError(f"method ssr-vlad: temporal must be 0 or more, got {temporal}")
        super().__init__(SSRVLAD(SSRVLADConfig.from_preset(preset, **settings)))
        self.temporal = temporal

    def encode_sweep(self, frames: Iterable[View]) -> Tensor:
        """``(Q, S, D)`` float32, ``D = config.length``, 480 by default; for residuals, which have
        no anchor, ``(Q, D)``."""
        swept = (self.describe(batch, COLUMNS) for batch in batches(frames, self.batch))
        return joined(swept, self.name)

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, D)`` float32, after Eq. 3."""
        sequences: list[str] = []
        return temporal_sum(self.encode_query(noting(frames, sequences)), sequences, self.temporal)


class LabelGrid(VectorMethod):
    """Square roots of the categories' fractions in the cells of a grid of 6 x 10, normalised.

    If the grid does not divide the image, neighbouring cells share pixels. Pixels of no category
    count in a cell's size. Label maps are read as SSR-VLAD reads them, so descriptors of different
    label spaces are comparable.
    """

    rows, columns = 6, 10
    name, length = "label-grid", len(CATEGORIES) * rows * columns
    needs = frozenset({LABELS})

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        maps, spaces = zip(*(labels_of(view, self.name) for view in views), strict=True)
        labels, space = torch.from_numpy(np.stack(maps)), label_space(spaces[0])
        categories = categorise(labels, *category_table(space))
        if bool((categories == UNKNOWN).any()):
            refuse_unknown(labels, space)
        layers = categories[:, None] == torch.arange(len(CATEGORIES))[:, None, None]
        fractions = F.adaptive_avg_pool2d(layers.float(), (self.rows, self.columns))
        return F.normalize(fractions.sqrt().flatten(1), dim=1)


def segmenter_of(
    network: Segmenter | str | Path | None, method: str, labels_as: str | LabelSpace = AUTO
) -> Segmenter:
    """A method's segmentation network, itself or by its name; none is a FileNotFoundError."""
    if network is None:
        raise FileNotFoundError(
            f"no network: {method} needs a segmentation network, by the setting network"
        )
    return network if isinstance(network, Segmenter) else Segmenter.load(network, labels_as)


class EncoderFeatures(VectorMethod, Features):
    """The features of a segmentation network, see `stages.features`. The network is a `Segmenter`
    or its name, see `open_network`, with the label space of its classes unless they or its YAML
    file define it. No network is a FileNotFoundError, one without features a ValueError."""

    shape = Features.shape
    needs = frozenset({PICTURE, "weights"})
    batch = 4

    def __init__(
        self, network: Segmenter | str | Path | None = None, labels_as: str | LabelSpace = AUTO
    ) -> None:
        self._segmenter = segmenter_of(network, self.name, labels_as)

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        pictures = [picture_of(view, self.name) for view in views]
        segmented = self._segmenter.segment(pictures, features=True)
        return torch.cat([torch.from_numpy(labels.features)[None] for labels in segmented])

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines of the best move, see `channels.signs`."""
        town = references_of({self.name: references}, [""] * len(references))
        scores, _ = town.compare({self.name: queries.numpy()}, sweep=True)
        return torch.from_numpy(scores)
