"""Signs, compared in packed bits, against plain matrices of 1 and -1."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.channels.signs import REACH, moved, numbers
from ssrvlad_torch.recognition.comparison import Member, ReferenceRows
from ssrvlad_torch.recognition.recognise import Steps, recognise

SHAPE = (8, 3, 4)


def grids(count, seed=0, shape=SHAPE):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.integers(0, 256, (count, *shape), np.uint8))


def drive(count, seed=0):
    """Signs of a drive, most of which all its frames share."""
    rng = np.random.default_rng(seed)
    same, own = rng.integers(0, 256, SHAPE, np.uint8), rng.integers(0, 256, (count, *SHAPE))
    few = rng.integers(0, 256, (count, *SHAPE)) & rng.integers(0, 256, (count, *SHAPE))
    return torch.from_numpy(same ^ (own & few).astype(np.uint8))


@given(st.integers(-3, 3))
def test_moved_columns_leave_zeros(columns):
    grid = grids(2)
    after = moved(grid, columns)
    for column in range(SHAPE[0]):
        source = column - columns
        inside = 0 <= source < SHAPE[0]
        expected = grid[:, source] if inside else torch.zeros_like(grid[:, 0])
        assert torch.equal(after[:, column], expected)


def plain(queries, references, sequences=None, reach=REACH):
    """The scores by matrices of numbers."""
    q, r = numbers(queries), numbers(references)
    if sequences is not None:
        q = q - q.mean(0)
        for name in dict.fromkeys(sequences):
            rows = torch.tensor([name == each for each in sequences])
            r[rows] -= r[rows].mean(0)
    scores = []
    for move in range(-reach, reach + 1):
        kept = [c for c in range(SHAPE[0]) if 0 <= c - move < SHAPE[0]]
        here, there = (each[:, kept].flatten(1) for each in (moved(q, move), r))
        scores.append(F.normalize(here, dim=1) @ F.normalize(there, dim=1).T)
    return torch.stack(scores).amax(0)


@pytest.mark.parametrize("reach", [0, REACH])
def test_scores_are_cosines_of_the_best_move(library, reach):
    queries, references = grids(7), grids(40, 1)
    references[3] = moved(queries, reach)[2]
    got = ReferenceRows(references, ["a"] * 40).compare(queries, False, bool(reach)).whole()
    torch.testing.assert_close(got, plain(queries, references, reach=reach), atol=1e-5, rtol=0)
    assert got[2].argmax() == 3


@pytest.mark.parametrize("reach", [0, REACH])
def test_standardised_scores_are_those_of_means_off(library, reach):
    queries, sequences = drive(50), ["a"] * 30 + ["b"] * 45
    references = torch.cat((drive(30, 1), drive(45, 2)))
    got = ReferenceRows(references, sequences).compare(queries, True, bool(reach))
    expected = plain(queries, references, sequences, reach)
    torch.testing.assert_close(got.whole(), expected, atol=1e-5, rtol=0)


def test_a_traverse_of_equal_frames_stays_as_it_is(library):
    frame, references = grids(1).expand(30, *SHAPE), grids(40, 1)
    rows = ReferenceRows(torch.cat((frame, references)), ["one"] * 30 + ["many"] * 40)
    score = rows.compare(frame.repeat(2, 1, 1, 1), True, False).whole()
    assert score.shape == (60, 70)
    torch.testing.assert_close(score[:, :30], torch.ones(60, 30))


@pytest.mark.parametrize("follow", [None, "offline"])
def test_recognise_takes_signs(follow):
    frames = drive(60)
    seen = frames[10:50] ^ (grids(40, 5) & grids(40, 6) & grids(40, 7))
    numbers_only = F.normalize(torch.rand(60, 16), dim=1)
    names = ["q"] * 40, ["r"] * 60
    members = {
        "ssr-vlad": Member(numbers_only[10:50], ReferenceRows(numbers_only, names[1])),
        "features": Member(seen, ReferenceRows(frames, names[1]), 6),
    }
    found = recognise(members, *names, Steps(follow=follow))
    assert found.matches.indices[:, 0].tolist() == list(range(10, 50))
    assert set(found.used["weights"]["q"]) == {"ssr-vlad", "features"}
