"""Fusion: the scores of several channels as one, by the native core."""

import pytest
import torch

from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.native.map import DescriptorMap

TRUST = {channel.name: channel.trust for channel in (LabelShapes, HOG, Features)}


def noisy(seed: int, noise: float, queries: int = 40, references: int = 60) -> torch.Tensor:
    """Scores of a method: the true match of query i is row i."""
    generator = torch.Generator().manual_seed(seed)
    shape = (queries, references)
    return 0.5 + 0.2 * torch.eye(*shape) + noise * torch.randn(shape, generator=generator)


def fuse(*members: torch.Tensor):
    """Scores and weights by methods that are trusted alike."""
    return fuse_named({str(number): scores for number, scores in enumerate(members)}, {})


def fuse_named(members, trust):
    town = DescriptorMap([next(iter(members.values())).shape[1]])
    for name in members:
        town.add(name, None, trust.get(name, 1.0))
    scores, taken = town.compare({name: scores.numpy() for name, scores in members.items()})
    return torch.from_numpy(scores), taken.weights


def recall(scores: torch.Tensor) -> float:
    return float((scores.argmax(1) == torch.arange(len(scores))).float().mean())


def test_two_methods_that_err_apart_are_better_together():
    one, other = noisy(0, 0.08), noisy(1, 0.08)
    scores, weights = fuse(one, other)
    assert recall(scores) > max(recall(one), recall(other)) + 0.1
    assert sum(weights.values()) == pytest.approx(1)


def test_a_method_without_information_hardly_weighs():
    good, bad = noisy(0, 0.03), noisy(1, 10.0).clamp(max=0.99)
    scores, weights = fuse(good, bad)
    assert weights["0"] > 3 * weights["1"]
    assert recall(scores) == recall(good) == 1


def test_trust_decides_until_frames_show_which_method_leads():
    alike = noisy(7, 0.05)
    _, few = fuse_named(dict.fromkeys(TRUST, torch.rand(3, 20)), TRUST)
    assert few == pytest.approx({"ssr-vlad": 1 / 9, "hog": 2 / 9, "features": 6 / 9})
    assert fuse_named(dict.fromkeys(TRUST, alike), TRUST)[1] == pytest.approx(few)
    both = {"features": noisy(8, 10.0).clamp(max=0.99), "hog": noisy(9, 0.01)}
    _, blind = fuse_named(both, TRUST)
    assert blind["hog"] > 3 * blind["features"]
