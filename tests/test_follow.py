"""`recognition.follow`: the sequence filter against a plain dense one, and what it is for."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssrvlad_torch.recognition.follow import NEAR, follow
from ssrvlad_torch.recognition.motion import BACKWARDS, SPEEDS, Motion, likelihoods


def transitions(sequences: list[str], motion: Motion) -> np.ndarray:
    """The whole transition matrix over (speed, row) and the unmapped state, the last one."""
    rows, speeds = len(sequences), len(SPEEDS)
    size = speeds * rows + 1
    matrix, enter = np.zeros((size, size)), start(rows)
    for before, row in itertools.product(range(speeds), range(rows)):
        here = before * rows + row
        for after, (chance, steps) in enumerate(SPEEDS):
            turned = motion.change * chance + (1 - motion.change) * (after == before)
            for step, part in steps.items():
                there = row + step
                if 0 <= there < rows and sequences[there] == sequences[row]:
                    target = after * rows + there
                    matrix[here, target] += (1 - motion.jump) * turned * part
        lost = 1 - matrix[here].sum()
        matrix[here] += lost * (1 - motion.unmapped) * enter
        matrix[here, -1] += lost * motion.unmapped
    matrix[-1] = (1 - motion.stay) * enter
    matrix[-1, -1] += motion.stay
    return matrix


def start(rows: int) -> np.ndarray:
    """The probabilities of all mapped states, and 0 for the unmapped one."""
    prior = np.array([chance for chance, _ in SPEEDS])
    return np.append(np.repeat(prior, rows) / rows, 0.0)


def plain(scores: Tensor, sequences: list[str], motion: Motion, future: int) -> np.ndarray:
    """``(Q, R + 1)`` probabilities of the rows and of no row, each query in the light of ``future``
    later ones."""
    rows, states = len(sequences), len(SPEEDS)
    matrix = transitions(sequences, motion)
    told = [np.append(np.tile(likelihoods(row, motion).numpy(), states), 1.0) for row in scores]
    first = start(rows) * (1 - motion.unmapped)
    first[-1] = motion.unmapped
    forward = [first * told[0]]
    for each in told[1:]:
        forward.append((forward[-1] / forward[-1].sum()) @ matrix * each)
    found = []
    for query, belief in enumerate(forward):
        back = np.ones(len(first))
        for later in reversed(told[query + 1 : query + 1 + future]):
            back = matrix @ (later * back)
            back /= back.max()
        both = belief * back / (belief * back).sum()
        found.append([*both[:-1].reshape(-1, rows).sum(0), both[-1]])
    return np.array(found)


@given(
    seed=st.integers(0, 1000),
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=3),
    queries=st.integers(1, 9),
    future=st.sampled_from((0, 2, 100)),
)
def test_equals_the_plain_model(seed, lengths, queries, future):
    generator = torch.Generator().manual_seed(seed)
    sequences = [name for name, n in zip("abc", lengths, strict=False) for _ in range(n)]
    scores = torch.rand(queries, len(sequences), generator=generator) * 1.2 - 0.3
    motion = Motion(change=0.1, jump=0.05, unmapped=0.2, stay=0.8, weight=1.0, level=0.5)
    expected = plain(scores, sequences, motion, future)
    mode = "offline" if future == 100 else "online"
    top = len(sequences)
    found = follow(scores, sequences, mode=mode, delay=future % 100, top=top, motion=motion)
    got = torch.zeros(queries, top).scatter(1, found.indices, found.scores)
    np.testing.assert_allclose(got.numpy(), expected[:, :-1], atol=2e-5)
    np.testing.assert_allclose(found.unmapped.numpy(), expected[:, -1], atol=2e-5)


def noisy(track: list[int], rows: int, seed: int = 0, strength: float = 0.25) -> Tensor:
    """Scores in which the true row stands out only on average."""
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(len(track), rows, generator=generator) * 0.5
    scores[range(len(track)), track] += strength
    return scores


TRACKS = {
    "as fast": list(range(20, 80)),
    "three times as fast": list(range(10, 160, 3)),
    "half as fast": [20 + i // 2 for i in range(80)],
    "with a stop": [*range(20, 50), *[50] * 20, *range(51, 80)],
    "with a jump": [*range(20, 60), *range(130, 170)],
}


@pytest.mark.parametrize("name", TRACKS)
def test_follows_where_single_frames_do_not(name):
    track = torch.tensor(TRACKS[name])
    scores = noisy(TRACKS[name], 200)
    single = ((scores.argmax(1) - track).abs() <= NEAR).float().mean()
    followed = follow(scores, ["map"] * 200).indices[:, 0]
    assert ((followed - track).abs() <= NEAR).float().mean() > max(0.9, single + 0.1)


def test_queries_may_run_the_map_backwards():
    track = torch.arange(120, 60, -1)
    scores = noisy(track.tolist(), 200)
    found = follow(scores, ["map"] * 200, way=BACKWARDS)
    assert ((found.indices[:, 0] - track).abs() <= NEAR).float().mean() > 0.9
    assert found.chance.median() < 1e-3


def test_queries_of_another_sequence_start_anew():
    scores = noisy(list(range(10, 30)), 60)
    both = follow(torch.cat((scores, scores)), ["m"] * 60, ["a"] * 20 + ["b"] * 20)
    once = follow(scores, ["m"] * 60)
    assert torch.equal(both.indices, torch.cat((once.indices, once.indices)))


def test_an_empty_query_is_placed_by_its_neighbours():
    scores = noisy(list(range(10, 40)), 60, strength=0.5)
    scores[15] = -torch.inf
    assert follow(scores, ["m"] * 60).indices[15, 0] == 25


def test_a_place_that_the_map_lacks_is_told():
    generator = torch.Generator().manual_seed(1)
    scores = torch.rand(60, 200, generator=generator) * 0.5
    scores[range(30), range(40, 70)] += 0.5
    found = follow(scores, ["m"] * 200, motion=Motion(weight=1.0, level=3.0))
    assert found.unmapped[:25].max() < 0.1 and found.unmapped[40:].min() > 0.9


def test_scores_may_be_an_array():
    assert follow(np.eye(30)[10:20], ["a"] * 30).indices[:, 0].tolist() == [*range(10, 20)]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"mode": "both"}, "online or offline, got 'both'"),
        ({"delay": -1}, "delay must be an integer from 0, got -1"),
        ({"delay": 1.5}, "delay must be an integer from 0, got 1.5"),
        ({"delay": math.nan}, "delay must be an integer from 0, got nan"),
        ({"top": 2**70}, "top must be at most 2147483647, got 1180591620717411303424"),
        ({"way": 5}, "way: expected 1 or -1, got 5"),
        ({"query_sequences": ["a"]}, "each of 3 queries, got 1"),
        ({"reference_sequences": ["m"] * 4}, "each of 4 rows, got"),
        (
            {"reference_sequences": ["m", "m", "n", "m", "n"]},
            "frames of 'm' together, got some at 3",
        ),
        ({"query_sequences": ["a", "b", "a"]}, "frames of 'a' together"),
        ({"scores": torch.full((3, 5), torch.nan)}, "at most 1, as cosines are, got nan"),
        ({"scores": torch.full((3, 5), 2.0)}, "at most 1, as cosines are, got 2"),
    ],
)
def test_refuses(arguments, said):
    with pytest.raises(ValueError, match=said):
        follow(**{"scores": torch.rand(3, 5), "reference_sequences": ["m"] * 5, **arguments})


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_a_row_without_a_score_is_no_candidate(mode):
    scores = torch.eye(30)[10:20]
    scores[:, 15] = -torch.inf
    found = follow(scores, ["drive"] * 30, mode=mode, top=30)
    assert (found.indices != 15).all()
    assert (found.indices[:, -1] == -1).all()
    assert found.indices[4, 0] == 14
