"""`recognition.follow`: what it is for; `test_recognition_reference` holds it to the oracle."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from ssrvlad_torch.recognition.follow import follow
from ssrvlad_torch.recognition.motion import BACKWARDS, NEAR, Motion


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
