"""The fast paths of recognition against `recognition.reference` on drives drawn at random."""

from dataclasses import astuple

import core as single
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_native_map import fused

from ssrvlad_torch.native import decide as core
from ssrvlad_torch.recognition import reference
from ssrvlad_torch.recognition.fusion import FusedScores
from ssrvlad_torch.recognition.motion import BACKWARDS, FORWARDS, Motion

TRUST = {"ssr-vlad": 1.0, "features": 6.0}
LENGTHS = st.lists(st.integers(1, 12), min_size=1, max_size=3)


def named(lengths):
    return [name for name, length in zip("abc", lengths, strict=False) for _ in range(length)]


def drawn(seed, queries, rows, holes=0.0):
    """Scores; some rows have none."""
    rng = np.random.default_rng(seed)
    scores = rng.uniform(-0.3, 0.9, (queries, rows)).astype(np.float32)
    scores[:, rng.random(rows) < holes] = -np.inf
    return scores


@given(
    seed=st.integers(0, 1000),
    queries=st.sampled_from((3, 35, 401)),
    holes=st.sampled_from((0, 0.3)),
)
@settings(max_examples=20)
def test_channels_as_one(seed, queries, holes):
    channels = {name: drawn(seed + n, queries, 40, holes) for n, name in enumerate(TRUST)}
    weights = reference.weights_of(channels, TRUST)
    fast = FusedScores({name: torch.from_numpy(each) for name, each in channels.items()}, TRUST)
    assert fast.weights == pytest.approx(weights, abs=1e-5)
    np.testing.assert_allclose(fast.whole(), fused(channels, weights), atol=1e-5)


@given(
    seed=st.integers(0, 1000),
    lengths=LENGTHS,
    queries=st.integers(1, 9),
    later=st.sampled_from((0, 2, 100)),
    way=st.sampled_from((FORWARDS, BACKWARDS)),
    rate=st.sampled_from((1, 0.25, 3)),
)
@settings(max_examples=60)
def test_a_drive_is_followed(seed, lengths, queries, later, way, rate):
    names = named(lengths)
    scores = drawn(seed, queries, len(names), 0.1)
    motion = Motion(change=0.1, jump=0.05, unmapped=0.2, stay=0.8, weight=1.0, rate=rate)
    expected, unmapped = reference.follow(scores, names, motion, way, later)
    starts = [names.index(name) for name in dict.fromkeys(names)]
    mode, numbers = "offline" if later == 100 else "online", astuple(motion)
    places = core.follow(scores, starts, len(names), mode, later % 100, len(names), numbers, way)
    for row, (probabilities, rows) in enumerate(zip(*places[:2], strict=True)):
        known = rows >= 0
        np.testing.assert_allclose(probabilities[known], expected[row][rows[known]], atol=2e-5)
    np.testing.assert_allclose(places.unmapped, unmapped, atol=2e-5)
    fast = core.gain(scores, starts, len(names), astuple(motion), way)
    assert fast == pytest.approx(reference.gain(scores, names, motion, way), abs=1e-3)


@pytest.mark.parametrize("way", [FORWARDS, BACKWARDS])
@pytest.mark.parametrize("rate", [1, 0.25, 3])
def test_probabilities_of_states_stay_one_and_back_is_the_transpose(way, rate):
    motion = Motion(change=0.1, jump=0.05, unmapped=0.2, stay=0.8, rate=rate)
    model = reference.Model(named((6, 1, 4)), motion, way)
    states = np.eye(len(model.start()))
    matrix = np.stack([model.after(each) for each in states])
    np.testing.assert_allclose(matrix.sum(1), 1)
    assert matrix.min() >= 0
    back = np.stack([model.before(each) for each in states])
    np.testing.assert_allclose(back, matrix.T, atol=1e-12)


@given(seed=st.integers(0, 1000), rows=st.integers(1, 200), steps=st.sampled_from((0, 3, 100)))
def test_an_answer_beside_its_rivals(seed, rows, steps):
    """Also of equal values."""
    values = drawn(seed, 1, rows, 0.2)[0]
    values = np.round(values * steps) / steps if steps else values
    fast = single.chance_of(torch.from_numpy(values))
    expected, rival = reference.chance(values)
    assert fast.chance == pytest.approx(expected, abs=1e-9)
    if steps == 0:
        assert fast.rival == rival


@given(
    seed=st.integers(0, 1000),
    queries=st.sampled_from((1, 7, 60)),
    right=st.sampled_from((0, 0.5, 1)),
)
def test_doubts_of_a_traverse(seed, queries, right):
    rng = np.random.default_rng(seed)
    chances = np.where(rng.random(queries) < right, rng.random(queries) ** 6, rng.random(queries))
    rows = np.sort(rng.integers(0, 100, queries))
    together = single.answers_together(rows)
    assert together == reference.answers_together(rows)
    chances[rng.random(queries) < 0.1] = np.nan
    has = reference.mapped(chances, together)
    np.testing.assert_allclose(single.mapped(chances, together), has, atol=1e-9)
    alone = np.where(rng.random(queries) < 0.3, 1, chances)
    got, expected = (each.mapped(alone, together, 0.3) for each in (single, reference))
    np.testing.assert_allclose(got, expected, atol=1e-9)
    sure = single.of_chances(chances, together)
    right, spread = reference.confidence(chances, has, together)
    np.testing.assert_allclose(sure.right, right, atol=1e-6)
    np.testing.assert_allclose(sure.spread, spread, atol=1e-6)
    got, expected = (each.confidence(chances, has, together, True) for each in (single, reference))
    np.testing.assert_allclose(got, expected, atol=1e-6)
