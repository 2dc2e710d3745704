"""Methods that are channels, SSR-VLAD, features and HOG, and the trivial ones, label grid and tiny
image."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import LABELS, PICTURE, Channel, View, batches, labels_of, picture_of
from ..channels.features import Features
from ..channels.hog import HOG, grays
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


class VectorMethod(Channel):
    """A channel of vectors as a method: of length 1, or zero for an empty frame. Queries and
    references are described alike, in batches."""

    batch = 16

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, *shape)``."""
        return torch.cat([*map(self.describe, batches(frames, self.batch))])

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, *shape)``, encoded as queries are."""
        return self.encode_query(frames)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines."""
        return score(queries, references)


class HOGMethod(VectorMethod, HOG):
    """HOG as a method."""


class SSRVLADMethod(VectorMethod, LabelShapes):
    """Raw descriptors of queries against references summed over ``temporal`` frames on each side
    inside a sequence (t of Eq. 3); ``settings`` replace fields of the preset."""

    def __init__(self, preset: str = "default", temporal: int = 0, **settings: Any) -> None:
        if temporal < 0:
            raise ValueError(f"method ssr-vlad: temporal must be 0 or more, got {temporal}")
        super().__init__(SSRVLAD(SSRVLADConfig.from_preset(preset, **settings)))
        self.temporal = temporal

    def encode_sweep(self, frames: Iterable[View]) -> Tensor:
        """``(Q, S, D)`` float32; for residuals, which have no anchor, ``(Q, D)``."""
        swept = [self.describe(batch, COLUMNS) for batch in batches(frames, self.batch)]
        return torch.cat(swept)

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, D)`` float32, after Eq. 3."""
        sequences: list[str] = []
        return temporal_sum(self.encode_query(noting(frames, sequences)), sequences, self.temporal)


class LabelGrid(VectorMethod):
    """Square roots of the categories' fractions in the cells of a grid of 6 x 10, normalised. Cells
    that the grid does not divide share pixels; pixels of no category count in a cell's size."""

    rows, columns = 6, 10
    name, shape = "label-grid", (len(CATEGORIES) * rows * columns,)
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
    """The features of a segmentation network, a `Segmenter` or its name, with the label space of
    its classes unless they define it. No network is a FileNotFoundError."""

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


WIDTH, HEIGHT, PATCH = 64, 32, 8

_BATCH = 16
_SCORES_AT_ONCE = 1 << 20
_LEAST_DEVIATION = 1e-4
_LEAST_Z = -80.0
"""Its exponential fits into a float32, so every reference has a finite score."""


class References(NamedTuple):
    """Encoded references: pictures ``(R, HEIGHT * WIDTH)`` float32, and their sequences."""

    pictures: Tensor
    sequences: list[str]


class TinyImage:
    """Mean absolute difference of tiny pictures, in deviations from the drive around it, as
    SeqSLAM.

    A picture is gray, reduced to 64 x 32, and each patch of 8 x 8 pixels has mean 0 and deviation
    1, or 0. With the mean m and the deviation s of the differences D of a query over the references
    of a sequence, the score of its frames is 1 - exp(-(m - D) / s), or 0 where all are alike."""

    name = "tiny-image"
    needs = frozenset({"images"})

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, HEIGHT * WIDTH)`` float32."""
        return torch.cat([*map(self._describe, batches(frames, _BATCH))])

    def encode_reference(self, frames: Iterable[View]) -> References:
        """The pictures, and the sequence of each."""
        sequences: list[str] = []
        return References(self.encode_query(noting(frames, sequences)), sequences)

    @torch.no_grad()
    def scores(self, queries: Tensor, references: References) -> Tensor:
        """``(Q, R)``: differences of the pictures, normalised over each reference sequence."""
        scores = torch.zeros(len(queries), len(references.pictures))
        _, numbers = np.unique(references.sequences, return_inverse=True)
        sequence = torch.from_numpy(numbers)
        at_once = max(1, _SCORES_AT_ONCE // len(references.pictures))
        for rows, block in zip(scores.split(at_once), queries.split(at_once), strict=True):
            difference = torch.cdist(block, references.pictures, p=1) / block.shape[1]
            rows.copy_(enhance(difference, sequence))
        return scores

    def _describe(self, frames: Sequence[View]) -> Tensor:
        pictures = grays(frames, self.name)[:, None].float()
        tiny = F.interpolate(pictures, (HEIGHT, WIDTH), mode="area")
        return normalise_patches(tiny[:, 0]).flatten(1)


def normalise_patches(pictures: Tensor) -> Tensor:
    """``(B, H, W)`` float pictures, sides multiples of 8, with mean 0 and standard deviation 1 in
    each patch of 8 x 8 pixels; a flat patch is zero."""
    patches = pictures.unflatten(2, (-1, PATCH)).unflatten(1, (-1, PATCH))
    centred = patches - patches.mean((2, 4), keepdim=True)
    deviation = centred.square().mean((2, 4), keepdim=True).sqrt()
    flat = deviation < _LEAST_DEVIATION
    normal: Tensor = centred / deviation.masked_fill(flat, torch.inf)
    return normal.flatten(3).flatten(1, 2)


def enhance(difference: Tensor, sequence: Tensor) -> Tensor:
    """Contrast enhancement of differences ``(Q, R)`` over each sequence of references, whose
    numbers are ``(R,)``: ``(Q, R)`` float32, at most 1, higher for more similar pictures."""
    scores = torch.zeros_like(difference, dtype=torch.float32)
    for number in sequence.unique():
        columns = sequence == number
        within = difference[:, columns].double()
        deviation, mean = torch.std_mean(within, 1, correction=0, keepdim=True)
        flat = deviation < _LEAST_DEVIATION
        z = ((mean - within) / deviation.masked_fill(flat, torch.inf)).clamp(min=_LEAST_Z)
        scores[:, columns] = -torch.expm1(-z).float()
    return scores
