"""The filter over candidates, against the filter over all rows."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssrvlad_torch.recognition.candidates import follow_candidates, gain_of_candidates
from ssrvlad_torch.recognition.follow import follow, gain
from ssrvlad_torch.recognition.motion import BACKWARDS, FORWARDS, Motion, moments


class Best:
    """Of scores of all rows the best few as candidates, and every so many rows as a sample."""

    def __init__(self, scores: Tensor, count: int, every: int = 1) -> None:
        self.matrix, self.count = scores, count
        self.rows = torch.arange(0, scores.shape[1], every)

    def __len__(self) -> int:
        return len(self.matrix)

    def candidates(self, query: int) -> Tensor:
        return self.matrix[query].topk(min(self.count, self.matrix.shape[1])).indices

    def scores(self, query: int, rows: Tensor) -> Tensor:
        return self.matrix[query, rows]

    def spread(self, query: int) -> tuple[float, float]:
        return moments(self.matrix[query, self.rows])

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        return self.rows, self.matrix[query, self.rows]


def drive(rows: int, queries: int, seed: int = 0, strength: float = 0.25) -> Tensor:
    """Scores of a drive along the middle of a map, in which the true row stands out on average."""
    scores = torch.rand(queries, rows, generator=torch.Generator().manual_seed(seed)) * 0.5
    scores[range(queries), range(rows // 3, rows // 3 + queries)] += strength
    return scores


@given(
    seed=st.integers(0, 1000),
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=3),
    count=st.integers(1, 9),
    way=st.sampled_from([("online", 0), ("online", 2), ("offline", 0)]),
    barred=st.booleans(),
)
def test_all_rows_as_candidates_give_what_the_whole_map_gives(seed, lengths, count, way, barred):
    generator = torch.Generator().manual_seed(seed)
    sequences = [name for name, n in zip("abc", lengths, strict=False) for _ in range(n)]
    scores = torch.rand(count, len(sequences), generator=generator) * 1.2 - 0.3
    if barred:
        scores[torch.rand(scores.shape, generator=generator) < 0.3] = -torch.inf
    motion = Motion(change=0.1, jump=0.05, unmapped=0.2, stay=0.8, weight=1.0, level=0.5)
    mode, delay = way
    options = {"mode": mode, "delay": delay, "top": len(sequences), "motion": motion}
    expected = follow(scores, sequences, **options)
    got = follow_candidates(Best(scores, len(sequences)), sequences, **options)
    torch.testing.assert_close(got.unmapped, expected.unmapped, atol=2e-5, rtol=0)
    torch.testing.assert_close(got.chance, expected.chance, atol=2e-3, rtol=0)
    torch.testing.assert_close(got.near, expected.near, atol=2e-5, rtol=0)
    torch.testing.assert_close(got.scores, expected.scores, atol=2e-5, rtol=0)


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_few_candidates_find_what_the_whole_map_finds(mode):
    scores = drive(3000, 120)
    whole = follow(scores, ["m"] * 3000, mode=mode)
    few = follow_candidates(Best(scores, 100, 10), ["m"] * 3000, mode=mode)
    true = torch.arange(1000, 1120)
    for found in (whole, few):
        right = (found.indices[:, 0] - true).abs() <= 1
        assert right[40:].float().mean() > 0.95
    assert (whole.near - few.near).abs().mean() < 0.1


def test_the_track_goes_on_where_no_candidate_is_found():
    scores = drive(3000, 60, strength=0.6)
    search = Best(scores, 20, 10)
    search.candidates = lambda query: (
        torch.arange(20) if 30 <= query < 36 else scores[query].topk(20).indices
    )
    found = follow_candidates(search, ["m"] * 3000, mode="online")
    assert found.indices[20:, 0].tolist() == list(range(1020, 1060))


@pytest.mark.parametrize("way", [FORWARDS, BACKWARDS])
def test_the_gain_is_that_of_all_rows(way):
    scores, motion, some = drive(40, 12), Motion(unmapped=0.0, rate=2), range(1, 12, 2)
    expected = gain(scores, ["m"] * 40, motion, way, some)
    got = gain_of_candidates(Best(scores, 40), ["m"] * 40, motion, way, some)
    assert got == pytest.approx(expected, abs=1e-3)


def test_an_empty_query_is_placed_by_its_neighbours():
    scores = drive(300, 30, strength=0.8)
    scores[15] = -torch.inf
    search = Best(scores, 20, 3)
    search.candidates = lambda query: (
        torch.zeros(0, dtype=torch.int64) if query == 15 else scores[query].topk(20).indices
    )
    assert follow_candidates(search, ["m"] * 300).indices[15, 0] == 115
    search.candidates = lambda query: torch.arange(query > 15, dtype=torch.int64)
    assert len(follow_candidates(search, ["m"] * 300).indices) == 30
