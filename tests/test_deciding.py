"""`recognition.deciding`: without the native core the oracle decides, and says so once."""

import warnings

import pytest
import torch
from test_decide import Best, noisy

from ssrvlad_torch import native
from ssrvlad_torch.recognition.recognise import Steps, recognise_by_scores, recognise_by_search

SCORES = noisy([*range(20, 50)], 60, strength=0.4)
NAMES = ["a"] * 55 + ["b"] * 5


@pytest.fixture
def without_core(monkeypatch):
    monkeypatch.setattr(native, "core", lambda: native.Core(None, "torch, for it was not built"))
    native._warn.cache_clear()
    yield
    native._warn.cache_clear()


def drive(run, _):
    """The search of the candidates of a drive."""
    search = Best(SCORES[run.start : run.stop], 60)
    search.width, search.weights = 0, {}
    return search


def found():
    """What is decided by all that is public."""
    steps = [Steps(), Steps(follow="online", delay=2), Steps(follow=None)]
    queries = ["q"] * 20 + ["r"] * 10
    scored = [recognise_by_scores(SCORES, queries, NAMES, each, 3) for each in steps]
    searched = recognise_by_search(drive, queries, NAMES, top=3)
    return [*scored, searched]


def test_the_oracle_decides_the_same_without_the_core_and_says_so_once(core, without_core):
    with pytest.warns(UserWarning, match="NumPy decides, slowly, for it was not built"):
        plain = found()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "core", lambda: core)
        fast = found()
    for ours, theirs in zip(plain, fast, strict=True):
        assert ours.used == theirs.used
        assert torch.equal(ours.matches.indices, theirs.matches.indices)
        for one, other in zip(
            (ours.matches.scores, *ours.sure), (theirs.matches.scores, *theirs.sure), strict=True
        ):
            assert one.dtype == other.dtype == torch.float32
            torch.testing.assert_close(one, other, atol=1e-5, rtol=0)


def test_a_map_need_not_stand_together_to_judge_queries_alone():
    mixed, alone = ["a", "b"] * 30, Steps(follow=None)
    found = recognise_by_scores(SCORES, ["q"] * 30, mixed, alone)
    assert found.matches.indices[:, 0].tolist() == SCORES.argmax(1).tolist()
    with pytest.raises(ValueError, match="frames of 'a' together"):
        recognise_by_scores(SCORES, ["q"] * 30, mixed)
