"""LoST-X (Garg, Suenderhauf, Milford, RSS 2018): the Local Semantic Tensor, then keypoints.

x_i is the feature vector at place i, m_is the probability of class s there, mu_s the mean feature
of class s. The equations are those of the paper, the layout that of the authors' program
(github.com/oravus/lostX), as the paper does not define every step."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import View, picture_of
from ..datasets.image_files import Pixels
from ..recognition.sweep import score
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace, label_space
from .channel_methods import segmenter_of
from .protocol import noting

DenseNetwork = Callable[[Tensor], tuple[Tensor, Tensor]]
"""``(1, H, W, 3)`` uint8 RGB -> ``(1, D, h, w)`` features and, at any resolution, ``(1, C, h',
w')`` probabilities, both float; channel c is of id c of a label space."""

_REACH = 7
_CANDIDATES = 10


class LoSTFrame(NamedTuple):
    """An encoded frame: a descriptor, and one keypoint per feature channel, at its maximum.

    Attributes:
        descriptor: ``(S * D,)`` float32.
        features: ``(P, D)`` float32, a vector of length 1 for every place of the image.
        width: the columns of the feature map, so place ``p`` is in column ``p % width``.
        places, labels: ``(D,)`` int64, the place of each keypoint, and its most likely class.
    """

    descriptor: Tensor
    features: Tensor
    width: int
    places: Tensor
    labels: Tensor


class LoSTX:
    """Descriptors of features by class; keypoints rank the best ten references again.

    A reference uses the mean features of 15 frames of its sequence, i - 7 to i + 7; a query only
    its own. Dimensions are not scaled over all queries, as a query must not depend on others.

    Args:
        network: a segmentation network, or its name, see `open_network`; or any function with
            features and class probabilities. None is a FileNotFoundError.
        labels_as: label space of its classes; by default that of the segmentation network.
        classes: names of classes in that space, by default the paper's; others are a ValueError.
        opposite: queries run in the opposite direction, so their keypoints are mirrored.
    """

    name = "lost-x"
    needs = frozenset({"images", "weights"})

    def __init__(
        self,
        network: DenseNetwork | Segmenter | str | Path | None = None,
        labels_as: str | LabelSpace | None = None,
        classes: Sequence[str] = ("road", "building", "vegetation"),
        opposite: bool = False,
    ) -> None:
        if network is None or isinstance(network, Segmenter | str | Path):
            segmenter = segmenter_of(network, self.name, labels_as or AUTO)
            labels_as, network = segmenter.label_space, dense_network(segmenter)
        self._network, self._opposite = network, opposite
        space = label_space(labels_as or "cityscapes-trainids")
        channels = range(space.channel_counts.start)
        ids = {label.name: label.id for label in space.classes if label.id in channels}
        if unknown := [name for name in classes if name not in ids]:
            has = ", ".join(ids)
            raise ValueError(f"label space {space.name} has no class {unknown[0]!r}; it has {has}")
        self._classes = torch.tensor([ids[name] for name in classes])

    def encode_query(self, frames: Iterable[View]) -> list[LoSTFrame]:
        """Descriptors with the mean features of each frame alone; 8 kB per place."""
        return self._encode(frames, reach=0)

    def encode_reference(self, frames: Iterable[View]) -> list[LoSTFrame]:
        """Descriptors with the mean features of the frames around each; 8 kB per place."""
        return self._encode(frames, _REACH)

    def scores(self, queries: list[LoSTFrame], references: list[LoSTFrame]) -> Tensor:
        """``(Q, R)``: minus the cosine distance times the layout cost, of the ten best references;
        then the others, and those with fewer than two pairs of keypoints, by their cosines."""
        descriptors = (
            torch.stack([frame.descriptor for frame in side]) for side in (queries, references)
        )
        distances = 1 - score(*descriptors)
        for query, row in zip(queries, distances, strict=True):
            costs = torch.full_like(row, math.inf)
            for r in row.argsort(stable=True)[:_CANDIDATES].tolist():
                costs[r] = row[r] * self._layout_cost(query, references[r])
            ranked = costs.isfinite()
            worst = costs[ranked].max() if bool(ranked.any()) else 0
            row.copy_(torch.where(ranked, costs, row + worst))
        return -distances

    def _layout_cost(self, query: LoSTFrame, reference: LoSTFrame) -> float:
        same = query.labels == reference.labels
        here, there = query.places[same], reference.places[same]
        count = len(reference.features)
        pairs, number = (here * count + there).unique(return_inverse=True)
        cosines = (query.features[pairs // count] * reference.features[pairs % count]).sum(dim=1)
        x, y = here % query.width, there % reference.width
        return layout_cost((query.width - 1 - x if self._opposite else x, y), 1 - cosines[number])

    @torch.no_grad()
    def _encode(self, frames: Iterable[View], reach: int) -> list[LoSTFrame]:
        sequences, encoded = list[str](), list[LoSTFrame]()
        sights = [self._sight(picture_of(frame, self.name)) for frame in noting(frames, sequences)]
        members = [(labels == self._classes[:, None]).float() for *_, labels in sights]
        parts = [
            (member @ features.flatten(1).mT, member.sum(dim=1, keepdim=True))
            for member, (features, *_) in zip(members, sights, strict=True)
        ]
        for i, (features, probabilities, labels) in enumerate(sights):
            window = range(max(0, i - reach), min(len(sights), i + reach + 1))
            around = [parts[j] for j in window if sequences[j] == sequences[i]]
            sums, places = (torch.stack(column).sum(0) for column in zip(*around, strict=True))
            means = sums / places.clamp(min=1)  # Eq. 2, over all places of the frames around
            flat = features.flatten(1)
            strongest = flat.argmax(dim=1)
            encoded.append(
                LoSTFrame(
                    lost_descriptor(flat, probabilities, means),
                    F.normalize(flat.mT.contiguous(), dim=1),
                    features.shape[2],
                    strongest,
                    labels[strongest],
                )
            )
        return encoded

    def _sight(self, image: Pixels) -> tuple[Tensor, Tensor, Tensor]:
        """Of one image features ``(D, h, w)``, and of each of the ``P = h * w`` places the
        probabilities of the classes, ``(S, P)``, and the most likely class, ``(P,)``."""
        features, scores = self._network(torch.tensor(image)[None])
        scores = F.interpolate(scores, features.shape[2:], mode="nearest-exact")[0].flatten(1)
        return features[0], F.normalize(scores, p=1, dim=0)[self._classes], scores.argmax(dim=0)


def dense_network(segmenter: Segmenter) -> DenseNetwork:
    """A network with its finest activation, or the one that is named, and a softmax behind it."""
    names = segmenter.features.names  # of an ONNX graph, outputs only now
    names = names if segmenter.config.features else names[:1]
    if len(names) != 1:
        raise ValueError(f"features: expected one activation for LoST-X, got {', '.join(names)}")

    def run(pictures: Tensor) -> tuple[Tensor, Tensor]:
        scores, [features] = segmenter.labels.run(pictures, names)
        if not scores.is_floating_point():
            raise ValueError("method lost-x: the network gives ids, expected class scores")
        return features.float().cpu(), scores.float().softmax(dim=1).cpu()

    return run


def layout_cost(columns: tuple[Tensor, Tensor], distances: Tensor) -> float:
    """Cost of M pairs of keypoints, low if they keep their order along the image: the cosine
    distance of their columns in both images, ``(M,)`` float each, weighted by how much smaller than
    the largest their ``distances`` are, by the weights' length and M. Infinity for fewer than two.
    """
    count = len(columns[0])
    if count < 2:
        return math.inf
    fractions = F.normalize(distances.double(), p=1, dim=0)
    weights = fractions.max() - fractions
    if not bool(weights.any()):
        weights = torch.full_like(weights, 1 / count)
    first, second = (weights * side.double() for side in columns)
    distance = 1 - F.cosine_similarity(first, second, dim=0)
    return float(distance.clamp(min=0) / weights.norm() / count)


def lost_descriptor(features: Tensor, probabilities: Tensor, means: Tensor) -> Tensor:
    """L_s = sum_i m_is |x_i - mu_s| (Eq. 1), each normalised, concatenated, ``(S * D,)`` of length
    1; of features ``(D, P)``, probabilities ``(S, P)`` and means ``(S, D)``."""
    residuals = [
        (features - mean[:, None]).abs() @ weight
        for mean, weight in zip(means, probabilities, strict=True)
    ]
    return F.normalize(F.normalize(torch.stack(residuals), dim=1).flatten(), dim=0)
