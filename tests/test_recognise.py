import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import refuses

from ssrvlad_torch.recognition.recognise import (
    AS_PAPER,
    Steps,
    recognise,
    recognise_by_scores,
    references_of,
)
from ssrvlad_torch.recognition.sweep import COLUMNS


def two_sequences(
    rows: int, noise: float, common: float = 2.0, near: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """Each frame looks like the ``near - 1`` before it."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(rows + near - 1, 64, generator=generator).unfold(0, near, 1).sum(-1)
    places /= near**0.5
    sequences = []
    for _ in range(2):
        shared = common * torch.randn(64, generator=generator)
        apart = noise * torch.randn(rows, 64, generator=generator)
        sequences.append(F.normalize(places + shared + apart, dim=1))
    return tuple(sequences)


def by_vectors(queries, references, query_names, names, *steps, **options):
    """What is recognised by one channel of vectors."""
    town = references_of({"x": references}, names)
    return recognise({"x": queries}, query_names, town, *steps, **options)


def whole(queries: torch.Tensor, references: torch.Tensor, *steps, **options):
    """What is recognised of one sequence of queries in a map of one sequence."""
    names = ["q"] * len(queries), ["r"] * len(references)
    return by_vectors(queries, references, *names, *steps, **options)


def right(answers, rows: torch.Tensor | None = None) -> float:
    """The fraction of the queries whose first candidate is their row, or their own number."""
    first = answers.matches.indices[:, 0]
    return (first == (torch.arange(len(first)) if rows is None else rows)).float().mean().item()


def test_each_step_finds_more():
    queries, references = two_sequences(80, 1.6)
    rates = [
        right(whole(queries, references, steps))
        for steps in (AS_PAPER, Steps(follow=None), Steps())
    ]
    assert rates == sorted(rates) and rates[0] < 0.9 * rates[-1] and rates[-1] > 0.97


def test_a_few_queries_have_no_mean_of_their_own():
    """Anchors of one picture have nearly all in common, which is where it was taken."""
    queries, references = two_sequences(80, 0.8, common=0.0)
    swept = F.normalize(queries[:, None] + 0.1 * torch.randn(80, len(COLUMNS), 64), dim=2)
    alone = [whole(query[None], references) for query in swept]
    answers = torch.stack([answer.matches.indices[0, 0] for answer in alone])
    assert (answers == torch.arange(80)).float().mean() > 0.9
    assert alone[0].used["standardise"] == {"q": False}
    assert whole(swept, references).used["standardise"] == {"q": True}


def test_a_map_in_small_folders_is_searched_as_one_that_is_whole():
    """Folders of two frames would have v and -v after their own means are subtracted."""
    queries, references = two_sequences(80, 0.8)
    for names in (["r"] * 80, [f"{row // 2:02d}" for row in range(80)]):
        assert right(by_vectors(queries, references, ["q"] * 80, names, Steps(follow=None))) > 0.95


ORDER = torch.arange(80)
SHUFFLED = torch.randperm(80, generator=torch.Generator().manual_seed(0))
FOLDERS = [f"{row // 5:02d}" for row in range(80)]


@pytest.mark.parametrize(
    ("order", "names", "likeness"),
    [(SHUFFLED, ["r"] * 80, {}), (ORDER, FOLDERS, {"common": 0.0, "near": 8})],
)
def test_queries_that_are_no_sequence_are_judged_one_by_one(order, names, likeness):
    """Shuffled ones, and those of a map in folders too short to be followed."""
    queries, references = two_sequences(80, 0.8, **likeness)
    answers, alone = (
        by_vectors(queries[order], references, ["q"] * 80, names, Steps(follow=follow))
        for follow in ("offline", None)
    )
    assert answers.used["follow"] == {"q": "no, following is no surer"}
    assert torch.equal(answers.matches.indices, alone.matches.indices)
    assert right(answers, order) > 0.6


@pytest.mark.parametrize("steps", [Steps(), AS_PAPER])
def test_excluded_references_and_those_that_are_not_allowed_are_no_candidates(steps):
    queries, references = two_sequences(30, 0.3)
    allowed, excluded = np.arange(30) % 7 != 3, np.arange(30)[:, None] + [0, 1]
    masks = {"allowed": allowed, "excluded": excluded}
    indices = whole(queries, references, steps, 3, **masks).matches.indices
    assert set(indices.unique().tolist()) <= {-1, *np.flatnonzero(allowed).tolist()}
    assert not (indices == torch.arange(30)[:, None]).any()


REFUSED = {
    "expected a sequence for each of 4 queries, got 1": {"query_names": ["a"]},
    "x: expected a row for each of 3 frames, got 4": {"names": ["b"] * 3},
    "top must be at most 2147483647": {"top": 2**70},
    r"allowed: expected shape \(4,\), got \(1,\)": {"allowed": np.ones(1, bool)},
    r"excluded: expected shape \(4, 2\), got \(4,\)": {"excluded": np.zeros(4, int)},
    "expected .* of real numbers in memory": {"queries": torch.eye(4) * 1j},
    r"x: expected \(Q, 13, D\) for columns .* got \(4, 5, 4\)": {"queries": torch.ones(4, 5, 4)},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_does_not_fit_is_refused(message):
    usual = {"queries": torch.eye(4), "references": torch.eye(4)}
    names = {"query_names": ["a"] * 4, "names": ["b"] * 4}
    refuses(message, lambda: by_vectors(**{**usual, **names, **REFUSED[message]}))


def test_a_map_need_not_stand_together_to_judge_queries_alone():
    scores = torch.rand(30, 60, generator=torch.Generator().manual_seed(0))
    mixed, alone = ["a", "b"] * 30, Steps(follow=None)
    answers = recognise_by_scores(scores, ["q"] * 30, mixed, alone)
    assert answers.matches.indices[:, 0].tolist() == scores.argmax(1).tolist()
    with pytest.raises(ValueError, match="frames of 'a' together"):
        recognise_by_scores(scores, ["q"] * 30, mixed)


@pytest.mark.parametrize("delay", [1.5, math.nan, True, -1, "1", None])
def test_a_delay_is_a_number_of_queries(delay):
    with pytest.raises(ValueError, match=f"delay must be an integer from 0, got {delay!r}"):
        Steps(follow="online", delay=delay)
    with pytest.raises(ValueError, match="expected 0, or more with follow online, got 2 with off"):
        Steps(delay=2)
    assert Steps(follow="online", delay=np.int64(2)) == Steps(follow="online", delay=2)
