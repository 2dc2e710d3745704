"""Running a method: order, ties, costs, and what it refuses."""

import pytest
import torch

from ssrvlad_torch.baselines.run import run
from ssrvlad_torch.channels.channel import View


class Numbers:
    """A method whose frames are numbers; those that are near score high, negative ones nothing."""

    name = "numbers"
    needs = frozenset({"labels"})

    def __init__(self):
        self.blocks = []

    def encode_query(self, frames):
        numbers = torch.tensor([float(frame.frame.rpartition("/")[2]) for frame in frames])
        self.blocks.append(len(numbers))
        return numbers

    encode_reference = encode_query

    def scores(self, queries, references):
        scores = -(queries[:, None] - references).abs()
        return scores.masked_fill((queries < 0)[:, None] | (references < 0), -torch.inf)


def numbered(sequence, *numbers):
    return (View(f"{sequence}/{number}") for number in numbers)


def test_candidates_are_ranked_and_ties_keep_the_order():
    queries, references = numbered("q", 2, 7, -1, 30), numbered("r", 0, 4, -1, 8, 6)
    found = run(Numbers(), queries, references, top=3)
    scores, indices = found.matches
    assert indices.tolist() == [[0, 1, 4], [3, 4, 1], [-1, -1, -1], [3, 4, 1]]
    inf = torch.inf
    assert scores.tolist() == [[-2, -2, -4], [-1, -1, -3], [-inf] * 3, [-22, -24, -26]]
    assert (scores.dtype, indices.dtype) == (torch.float32, torch.int64)
    assert found.bytes_a_reference == 4


def test_the_first_query_is_done_twice_references_once_and_progress_counts_each():
    method, done = Numbers(), []
    run(method, numbered("q", 1, 2, 3), numbered("r", 5, 6, 7, 8), progress=done.append)
    assert method.blocks == [4, 1, 1, 1, 1]
    assert done == [1] * 7


def test_costs_are_milliseconds_a_query(monkeypatch):
    ticks = iter([0.0, 0.004, 0.006, 1.0, 1.002, 1.003])
    monkeypatch.setattr("ssrvlad_torch.baselines.run.time.perf_counter", lambda: next(ticks))
    found = run(Numbers(), numbered("q", 1, 2), numbered("r", 5))
    assert found.encode == pytest.approx({"average": 3, "min": 2, "max": 4})
    assert found.match == pytest.approx({"average": 1.5, "min": 1, "max": 2})


@pytest.mark.parametrize(
    ("queries", "references", "settings", "message"),
    [
        ((1,), (), {}, "method numbers got no references"),
        ((), (1,), {}, "method numbers got no queries"),
        ((1,), (1,), {"top": 0}, "a top of 1 or more, got 0"),
    ],
)
def test_missing_frames_and_a_top_of_zero_are_refused(queries, references, settings, message):
    with pytest.raises(ValueError, match=message):
        run(Numbers(), numbered("q", *queries), numbered("r", *references), **settings)
