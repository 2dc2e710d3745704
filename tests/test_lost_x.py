"""LoST-X against its equations as loops, and the method: windows of references, keypoints, ranking
again, errors."""

import methods
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import refuses
from methods import Array, noise, unit
from scipy.spatial.distance import cosine
from torch import Tensor, nn

from ssrvlad_torch.baselines.lost_x import LoSTX, dense_network
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter

CHANNELS, CLASSES = 40, 4
SEEN = [0, 2, 3]
SPACE = """
name: small
source: made up
classes:
  - {id: 0, name: road, category: ground}
  - {id: 1, name: car, category: dynamic}
  - {id: 2, name: building, category: building}
  - {id: 3, name: vegetation, category: vegetation}
"""


def mean_feature(features: Array, labels: Array, s: int) -> Array:
    """Eq. 2: the mean over the places whose most likely class is s."""
    members = [x for x, label in zip(features.T, labels, strict=True) if label == s]
    return sum(members) / len(members) if members else np.zeros(len(features))


def described(features: Array, probabilities: Array, means: list[Array]) -> Array:
    """Eq. 1: L_s = sum_i m_is |x_i - mu_s|, each of length 1, put one after another."""
    parts = []
    for s, mean in zip(SEEN, means, strict=True):
        total = np.zeros(len(features))
        for x, odds in zip(features.T, probabilities.T, strict=True):
            total += odds[s] * np.abs(x - mean)
        parts.append(unit(total))
    return unit(np.concatenate(parts))


def network(images: Tensor) -> tuple[Tensor, Tensor]:
    """Random projections of 8 x 8 blocks; the class probabilities come at twice the resolution."""
    random = torch.Generator().manual_seed(0)
    images = images.permute(0, 3, 1, 2) / 255
    features = F.conv2d(images - 0.5, torch.randn(CHANNELS, 3, 8, 8, generator=random), stride=8)
    scores = F.conv2d(images - 0.5, torch.randn(CLASSES, 3, 4, 4, generator=random), stride=4)
    return features, scores.softmax(dim=1)


def seen(frame: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features ``(D, P)``, probabilities ``(4, P)`` and most likely classes, place by place."""
    features, scores = (
        output[0].double().numpy() for output in network(torch.tensor(frame.picture)[None])
    )
    nearest = scores[:, 1::2, 1::2]  # of four places in a square the one after the middle
    probabilities = nearest.reshape(CLASSES, -1)
    return features.reshape(CHANNELS, -1), probabilities, probabilities.argmax(axis=0)


def frames(count: int, sequence: str = "drive", seed: int = 0) -> list[View]:
    return methods.frames((noise(100 * seed + n) for n in range(count)), sequence)


@pytest.fixture
def space(tmp_path):
    (tmp_path / "small.yaml").write_text(SPACE)
    return str(tmp_path / "small.yaml")


@pytest.fixture
def method(space):
    return LoSTX(network=network, labels_as=space)


def test_a_query_is_the_equations_on_what_the_network_saw(method):
    for frame, encoded in zip(frames(3), method.encode_query(frames(3)), strict=True):
        features, probabilities, labels = seen(frame)
        means = [mean_feature(features, labels, s) for s in SEEN]
        expected = described(features, probabilities, means)
        np.testing.assert_allclose(encoded.descriptor.numpy(), expected, atol=1e-5)
        strongest = features.argmax(axis=1)
        assert encoded.places.tolist() == strongest.tolist()
        assert encoded.labels.tolist() == labels[strongest].tolist()
        assert encoded.width == 6


def test_references_take_means_over_15_frames_of_their_sequence(method):
    references = frames(20, "a") + frames(3, "b", seed=1)
    encoded = method.encode_reference(references)
    for i, near in ((0, range(8)), (10, range(3, 18)), (19, range(12, 20)), (21, range(20, 23))):
        sights = [seen(references[j]) for j in near]
        together = np.concatenate([features for features, _, _ in sights], axis=1)
        labels = np.concatenate([labels for _, _, labels in sights])
        means = [mean_feature(together, labels, s) for s in SEEN]
        features, probabilities, _ = seen(references[i])
        expected = described(features, probabilities, means)
        np.testing.assert_allclose(encoded[i].descriptor.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("opposite", [False, True])
def test_the_ten_best_are_ranked_by_their_key_points(space, opposite):
    method = LoSTX(network=network, labels_as=space, opposite=opposite)
    queries, references = frames(4, "query", seed=1), frames(15, "reference", seed=2)
    q, r = method.encode_query(queries), method.encode_reference(references)
    scores = method.scores(q, r)
    distances = 1 - torch.tensor([[float(a.descriptor @ b.descriptor) for b in r] for a in q])
    for i, row in enumerate(scores):
        best = distances[i].argsort()[:10].tolist()
        costs = {}
        for j in best:
            costs[j] = float(distances[i, j]) * layout(queries[i], references[j], opposite)
            assert row[j] == pytest.approx(-costs[j], rel=1e-4)
        others = sorted(set(range(15)) - set(best), key=lambda j: distances[i, j])
        ranked = sorted(costs, key=lambda j: costs[j]) + others
        assert row.argsort(descending=True).tolist() == ranked
        assert row[others].max() < row[best].min()


def layout(query: View, reference: View, opposite: bool) -> float:
    """The cost, by the authors' steps, over the channels whose strongest places in both images have
    one class."""
    (one, _, labels_one), (other, _, labels_other) = seen(query), seen(reference)
    columns, distances = [], []
    for d in range(CHANNELS):
        a, b = int(one[d].argmax()), int(other[d].argmax())
        if labels_one[a] == labels_other[b]:
            columns.append((5 - a % 6 if opposite else a % 6, b % 6))
            distances.append(cosine(one[:, a], other[:, b]))
    x, y = np.array(columns, float).T
    fractions = np.array(distances) / sum(distances)
    weights = fractions.max() - fractions
    return cosine(x * weights, y * weights) / np.linalg.norm(weights) / len(x)


def test_class_names_come_from_the_label_space(space):
    with pytest.raises(ValueError, match="small has no class 'tree'; it has road, car, building"):
        LoSTX(network=network, labels_as=space, classes=("road", "tree"))
    refuses("camvid-11 has no class 'vegetation'", LoSTX, network=network, labels_as="camvid-11")
    LoSTX(network=network, labels_as="camvid-11", classes=("road", "building", "tree"))
    refuses("no class 'license plate'", LoSTX, network=network, classes=("license plate",))


def test_a_segmentation_network_gives_features_and_probabilities(tmp_path, space):
    torch.manual_seed(0)
    trunk = [nn.Conv2d(3, CHANNELS, 8, stride=8), nn.ReLU(), nn.Conv2d(CHANNELS, 2 * CHANNELS, 1)]
    layers = nn.Sequential(*trunk, nn.Conv2d(2 * CHANNELS, CLASSES, 1), nn.Upsample(scale_factor=8))
    config = SegmenterConfig(mean=(0, 0, 0), std=(1, 1, 1), features=("0",))
    segmenter = Segmenter(layers, space, config)
    picture = torch.tensor(frames(1)[0].picture)[None]
    features, scores = dense_network(segmenter)(picture)
    numbers = picture.permute(0, 3, 1, 2) / 255
    torch.testing.assert_close(features, layers[0](numbers))
    torch.testing.assert_close(scores, layers(numbers).softmax(1))
    method = LoSTX(network=segmenter)
    assert method.encode_query(frames(1))[0].places.shape == (CHANNELS,)
    several = SegmenterConfig(features=("0", "2"))
    with pytest.raises(ValueError, match="expected one activation for LoST-X, got 0, 2"):
        LoSTX(network=Segmenter(layers, space, several))
