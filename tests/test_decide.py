"""`native.decide`: the decision core is held to `recognition.reference`, on drives at random."""

import sys
from dataclasses import astuple

import numpy as np
import pytest
import torch
from helpers import outcome
from hypothesis import given, settings
from hypothesis import strategies as st

from ssrvlad_torch.native import decide as by_core
from ssrvlad_torch.native.decide import Search, decide, follow, gain
from ssrvlad_torch.recognition import reference
from ssrvlad_torch.recognition.fusion import moments
from ssrvlad_torch.recognition.motion import BACKWARDS, FORWARDS, NEAR, Course, Motion

TRACKS = {
    "as fast": list(range(20, 80)),
    "three times as fast": list(range(10, 160, 3)),
    "half as fast": [20 + i // 2 for i in range(80)],
    "with a stop": [*range(20, 50), *[50] * 20, *range(51, 80)],
    "with a jump": [*range(20, 60), *range(130, 170)],
}
MODES = st.sampled_from([("offline", 0), ("online", 0), ("online", 3), (None, 0)])


class Best:
    """Of scores of all rows the best few as candidates, and every so many rows as a sample."""

    def __init__(self, scores, count, every=1):
        self.matrix, self.count = np.asarray(scores), count
        self.rows = np.arange(0, self.matrix.shape[1], every)

    def __len__(self):
        return len(self.matrix)

    def candidates(self, query):
        return np.argsort(-self.matrix[query])[: self.count]

    def scores(self, query, rows):
        return self.matrix[query, rows]

    def spread(self, query):
        return moments(torch.from_numpy(self.matrix[query, self.rows]))

    def sample(self, query):
        return self.rows, self.matrix[query, self.rows]


def noisy(track, rows, seed=0, strength=0.25):
    """Scores in which the true row stands out only on average."""
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(len(track), rows, generator=generator) * 0.5
    scores[range(len(track)), track] += strength
    return scores


def tracks(kind, queries, start):
    """The rows of a drive, and of queries that are none."""
    numbers = np.arange(queries)
    return {
        "forwards": start + numbers,
        "backwards": start - numbers,
        "fast": start + 3 * numbers,
        "slow": start + numbers // 4,
        "two streams": np.where(numbers % 2, start, start // 2) + numbers // 2,
        "none": np.full(queries, -1),
    }[kind]


@st.composite
def drives(draw, most=40):
    """Scores of queries, and the first row of each drive of the map."""
    lengths = draw(st.lists(st.integers(1, most), min_size=1, max_size=3))
    rows, queries = sum(lengths), draw(st.integers(1, most))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    scores = rng.uniform(-0.2, 0.5, (queries, rows))
    kinds = ["forwards", "backwards", "fast", "slow", "two streams", "none"]
    track = tracks(draw(st.sampled_from(kinds)), queries, int(rng.integers(rows)))
    inside = (track >= 0) & (track < rows)
    scores[np.arange(queries)[inside], track[inside]] += draw(st.sampled_from((0.3, 0.5)))
    scores[:, rng.random(rows) < draw(st.sampled_from((0, 0.2)))] = -np.inf
    scores[rng.random(scores.shape) < draw(st.sampled_from((0, 0.1)))] = -np.inf
    scores[rng.random(queries) < draw(st.sampled_from((0, 0.1)))] = -np.inf
    return scores.astype(np.float32), [0, *np.cumsum(lengths)[:-1].tolist()]


def names_of(starts, rows):
    return [str(drive) for drive in np.searchsorted(starts, np.arange(rows), "right")]


def assert_same(got, expected, atol=1e-5):
    """Beliefs of the core are float32, and rounding adds up from query to query."""
    assert got[5:9] == tuple(expected[5:9])
    assert got.gain == pytest.approx(expected.gain, abs=1e-6)
    np.testing.assert_array_equal(got.rows, expected.rows)
    within = atol if got.followed else 1e-6
    np.testing.assert_allclose(got.scores, expected.scores, atol=within, rtol=0)
    for name in ("right", "spread"):  # of steps between rivals, which may be small
        of = 2e-4 if got.followed else within
        np.testing.assert_allclose(getattr(got, name), getattr(expected, name), atol=of)
    np.testing.assert_allclose(got.together, expected.together, rtol=1e-6)


@given(drive=drives(), mode=MODES, top=st.integers(1, 6))
@settings(max_examples=60)
def test_the_decision_is_that_of_the_oracle(drive, mode, top):
    scores, starts = drive
    rows = scores.shape[1]
    assert_same(
        decide(scores, starts, rows, *mode, top),
        reference.decide(scores, names_of(starts, rows), *mode, top),
    )


@given(drive=drives(), mode=MODES)
def test_scores_with_ties_give_the_candidates_of_the_oracle(drive, mode):
    """Where two rows are equal, the belief in them is rounded, and either may be first."""
    scores, starts = drive
    scores, rows = np.round(scores * 5) / 5, scores.shape[1]
    got = decide(scores, starts, rows, *mode)
    expected = reference.decide(scores, names_of(starts, rows), *mode, 5)
    assert got[5:9] == tuple(expected[5:9])
    if not got.followed:
        assert_same(got, expected)
    np.testing.assert_allclose(got.scores[:, 1:], expected.scores[:, 1:], atol=1e-5)


@given(drive=drives(), mode=MODES)
@settings(max_examples=40)
def test_all_rows_as_candidates_decide_as_scores_do(drive, mode):
    scores, starts = drive
    scores = np.where(scores > -np.inf, scores, np.float32(-0.5))
    rows = scores.shape[1]
    expected = decide(scores, starts, rows, *mode)
    assert_same(decide(Best(scores, rows), starts, rows, *mode), expected)


def test_a_query_of_scores_that_are_equal_but_for_rounding_says_nothing():
    scores = noisy([*range(5, 25)], 80, strength=0.25).numpy()
    scores[8] = -0.5
    rounded = scores.copy()
    rounded[8] += np.random.default_rng(0).uniform(-1e-6, 1e-6, 80)
    expected = decide(scores, [0], 80, "offline")
    assert expected.followed
    assert_same(decide(rounded, [0], 80, "offline"), expected)
    assert_same(expected, reference.decide(rounded, ["a"] * 80, "offline", 0, 5))


@given(
    drive=drives(), way=st.sampled_from((FORWARDS, BACKWARDS)), rate=st.sampled_from((1, 0.25, 3))
)
@settings(max_examples=40)
def test_the_gain_is_that_of_the_oracle(drive, way, rate):
    scores, starts = drive
    rows, motion = scores.shape[1], Motion(unmapped=0.0, rate=rate)
    expected = reference.gain(scores, names_of(starts, rows), motion, way)
    for evidence in (scores, Best(scores, rows)):
        got = gain(evidence, starts, rows, astuple(motion), way)
        assert got == pytest.approx(expected, abs=1e-5)


def test_scores_on_demand_and_a_part_of_the_queries_decide_as_a_matrix_does():
    scores = noisy([*range(20, 60)], 100, strength=0.5).numpy()

    class OnDemand:
        def __len__(self):
            return len(scores)

        def __getitem__(self, query):
            return scores[query].astype(np.float64)

    expected = decide(scores[5:33].copy(), [0, 50], 100)
    for evidence in (scores, OnDemand()):
        got = decide(evidence, [0, 50], 100, queries=range(5, 33))
        for ours, theirs in zip(got, expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("name", TRACKS)
def test_follows_where_single_frames_do_not(name):
    track = np.array(TRACKS[name])
    scores = noisy(TRACKS[name], 200).numpy()
    single = (np.abs(scores.argmax(1) - track) <= NEAR).mean()
    followed = follow(scores, [0], 200).rows[:, 0]
    assert (np.abs(followed - track) <= NEAR).mean() > max(0.9, single + 0.1)


def test_a_place_that_the_map_lacks_is_told():
    scores = noisy([*range(40, 100)], 200, seed=1, strength=0.5)
    scores[30:, 70:100] -= 0.5 * torch.eye(30)
    found = follow(scores.numpy(), [0], 200, motion=astuple(Motion(weight=1.0, level=3.0)))
    assert found.unmapped[:25].max() < 0.1 and found.unmapped[40:].min() > 0.9


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_a_row_without_a_score_is_no_candidate(mode):
    scores = np.eye(30, dtype=np.float32)[10:20]
    scores[:, 15] = -np.inf
    found = follow(scores, [0], 30, mode, top=30)
    assert (found.rows != 15).all() and (found.rows[:, -1] == -1).all()
    assert found.rows[4, 0] == 14


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_few_candidates_find_what_the_whole_map_finds(mode):
    scores = noisy([*range(1000, 1120)], 3000).numpy()
    true = np.arange(1000, 1120)
    whole, few = (follow(each, [0], 3000, mode) for each in (scores, Best(scores, 100, 10)))
    for found in (whole, few):
        assert (np.abs(found.rows[:, 0] - true) <= 1)[40:].mean() > 0.95
    assert np.abs(whole.near - few.near).mean() < 0.1


def test_the_track_goes_on_where_no_candidate_is_found():
    scores = noisy([*range(1000, 1060)], 3000, strength=0.5).numpy()
    search = Best(scores, 20, 10)
    best = search.candidates
    search.candidates = lambda query: np.arange(20) if 30 <= query < 36 else best(query)
    found = follow(search, [0], 3000, "online")
    assert found.rows[20:, 0].tolist() == list(range(1020, 1060))


def test_an_empty_query_is_placed_by_its_neighbours_but_has_no_candidate():
    scores = noisy([*range(100, 130)], 300, strength=0.5).numpy()
    scores[15] = -np.inf
    search = Best(scores, 20, 3)
    best = search.candidates
    search.candidates = lambda query: [] if query == 15 else best(query)
    for evidence in (scores, search):
        assert follow(evidence, [0], 300).rows[15, 0] == 115
        decision = decide(evidence, [0], 300)
        assert decision.followed and decision.rows[14, 0] == 114
        assert (decision.rows[15] == -1).all() and decision.right[15] == 0
    search.candidates = lambda query: np.arange(query > 15)
    assert len(follow(search, [0], 300).rows) == 30


ROWS = 240
RANDOM = np.random.default_rng(0)
COURSES = {
    **{name: (track, Course()) for name, track in TRACKS.items()},
    "in reverse order": (range(120, 60, -1), Course(BACKWARDS)),
    "every sixth row": (range(5, ROWS, 6), Course(rate=3)),
    "eight frames a row": (np.repeat(range(20, 60), 8), Course(rate=0.25)),
    "two streams in turn": (
        [row for both in zip(range(60), range(140, 200), strict=True) for row in both],
        Course(streams=2),
    ),
    "ten photographs": (RANDOM.integers(0, ROWS, 10), None),
    "standing still, or a row that is like every query": ([70] * 40, None),
    "a single one": ([70], None),
    "none": ([], None),
}


@pytest.mark.parametrize("name", COURSES)
def test_how_queries_run_a_map(name):
    track, expected = COURSES[name]
    found = decide(noisy([*track], ROWS, strength=0.5).numpy(), [0], ROWS)
    assert found[6:9] == (expected or Course()) and (found.gain > 0) == (expected is not None)
    if expected:
        right = np.abs(found.rows[:, 0] - np.array(track)) <= NEAR
        assert found.followed and right.mean() > 0.9


def test_a_map_in_another_order_is_run_by_hardly_anything():
    scores = noisy([*range(60)], ROWS, strength=0.5).numpy()
    assert decide(scores[:, RANDOM.permutation(ROWS)], [0], ROWS).gain < 0.1
    assert decide(scores, [0], ROWS).gain > 0.5


def seen_in_a_street(queries, rows):
    """Scores of places of a street, by numbers that change slowly along it."""
    rng = np.random.default_rng(1)
    street = rng.normal(size=(200, 64))
    street = sum(np.roll(street, place, 0) for place in range(5))
    here, there = (
        torch.from_numpy(street[places] + 0.7 * rng.normal(size=(len(places), 64)))
        for places in (queries, rows)
    )
    return torch.cosine_similarity(here[:, None], there, 2).float().numpy()


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_answers_that_linger_where_the_map_has_a_hole_are_not_believed(mode):
    drive, whole = np.arange(20, 120), np.arange(150)
    found = decide(seen_in_a_street(drive, whole), [0], 150, mode)
    assert found.followed and found.right.mean() > 0.95
    rows = whole[(whole < 60) | (whole >= 70)]
    lacking = decide(seen_in_a_street(drive, rows), [0], len(rows), mode)
    assert lacking.followed and lacking.right[43:47].mean() < 0.05
    assert lacking.right[:36].mean() > 0.95 and lacking.right[56:].mean() > 0.95


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_answers_of_a_drive_that_stands_linger_rightly(mode):
    stops = np.array([*range(20, 60), *[60] * 30, *range(61, 110)])
    found = decide(seen_in_a_street(stops, np.arange(150)), [0], 150, mode)
    assert found.followed and found.right[42:68].mean() > 0.9


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_answers_of_a_drive_denser_than_the_map_do_not_linger(mode):
    """Ten frames a row, along places of which the map has every tenth."""
    rng = np.random.default_rng(1)
    street = rng.normal(size=(1400, 64))
    street = sum(np.roll(street, place, 0) for place in range(50)) / 7
    here = torch.from_numpy(street[300:900] + 0.5 * rng.normal(size=(600, 64)))
    there = torch.from_numpy(street[::10] + 0.5 * rng.normal(size=(140, 64)))
    scores = torch.cosine_similarity(here[:, None], there, 2).float().numpy()
    found = decide(scores, [0], 140, mode)
    assert found.followed and found.right[20:].mean() > 0.9


def test_queries_that_are_equal_are_at_one_place():
    """More than half of a drive stands; rounding must not tell how far its frames are apart."""
    stops = np.array([*[20] * 80, *range(20, 60), *[60] * 80, *range(60, 100)])
    scores = seen_in_a_street(np.arange(150), np.arange(150))[stops]
    found = decide(scores, [0], 150, "offline")
    wanted = reference.decide(scores, ["a"] * 150, "offline", 0, 5)
    assert found.followed == wanted.followed
    np.testing.assert_allclose(found.right, wanted.right, atol=1e-3)
    assert found.right[5:75].mean() > 0.9


def test_a_long_drive_computes_beliefs_again_with_the_same_places():
    """Of a map whose beliefs are too many to be kept."""
    scores = noisy([*range(5000, 5050)], 60_000, strength=0.4).numpy()
    assert scores.size * 7 > 1 << 24
    whole = follow(scores, [0, 20_000], 60_000)
    part = follow(np.ascontiguousarray(scores[:, 4000:6000]), [0], 2000)
    assert whole.rows[:, 0].tolist() == (part.rows[:, 0] + 4000).tolist() == [*range(5000, 5050)]


def test_few_rows_give_no_confidence():
    scores = noisy([*range(5, 25)], 29, strength=0.5).numpy()
    assert not decide(scores, [0], 29).right.any()
    assert decide(np.pad(scores, ((0, 0), (0, 1))), [0], 30).right.any()


def test_no_queries_and_no_rows_give_no_candidates():
    for shape in ((0, 5), (3, 0), (0, 0)):
        found = decide(np.zeros(shape, np.float32), [0][: shape[1]], shape[1], top=2)
        assert found.rows.shape == (shape[0], 2) and (found.rows == -1).all()
        assert not found.right.any() and not found.followed


class Broken(Best):
    def __init__(self, name):
        super().__init__(np.zeros((4, 40), np.float32), 3)
        setattr(self, name, self.fail)

    def fail(self, *_):
        raise KeyError("the disk is gone")


def test_a_sample_of_other_rows_for_some_queries_is_refused():
    scores = noisy([*range(20, 60)], 100, strength=0.5).numpy()
    search = Best(scores, 20)
    whole = search.sample
    search.sample = lambda query: [each[: 100 - query] for each in whole(query)]
    with pytest.raises(ValueError, match="the same sample of rows for each query, not for 1"):
        decide(search, [0], 100)


SAMPLE = np.arange(0, 40, 4)


@pytest.mark.parametrize(
    ("name", "found", "said"),
    [
        ("scores", np.zeros(40), r"scores: expected shape \(3,\), got \(40,\)"),
        ("scores", np.zeros(2), r"scores: expected shape \(3,\), got \(2,\)"),
        ("scores", [0, np.nan, 0], "scores: expected scores of at most 1, as cosines are, got nan"),
        ("candidates", np.zeros((3, 2)), r"candidates: expected shape \(6,\), got \(3, 2\)"),
        ("sample", (SAMPLE, np.zeros(40)), r"sample: expected shape \(10,\), got \(40,\)"),
        ("sample", (SAMPLE, np.full(10, 5)), "sample: expected scores of at most 1"),
        ("spread", (0.3, 0.2, 0.1), r"spread: expected shape \(2,\), got \(3,\)"),
        ("spread", (np.nan, 0.2), r"spread: expected a finite mean .* got \[nan, 0.2\]"),
    ],
)
def test_what_a_search_returns_is_checked(name, found, said):
    search = Best(np.zeros((4, 40), np.float32), 3)
    setattr(search, name, lambda *_: found)
    with pytest.raises(ValueError, match=said):
        decide(search, [0], 40)


def test_a_search_may_return_other_candidates_each_time():
    search, asked = Best(noisy([*range(20, 60)], 100, strength=0.5).numpy(), 3), []
    search.candidates = lambda query: asked.append(query) or np.arange(len(asked) % 90)
    assert decide(search, [0], 100).rows.max() < 90


@pytest.mark.parametrize("score", [np.nan, np.inf, 5.0])
@pytest.mark.parametrize("mode", [None, "online", "offline"])
@pytest.mark.parametrize("form", [np.asarray, lambda scores: Best(scores, 40)])
def test_one_score_that_is_none_is_refused_by_the_core_too(score, mode, form, monkeypatch):
    one = np.zeros((1, 40), np.float32)
    one[0, 3] = score
    with pytest.raises(ValueError, match="scores: expected scores of at most 1"):
        decide(form(one), [0], 40, mode)
    monkeypatch.setattr(by_core, "_array", lambda _, some, kind, *__: np.asarray(some, kind))
    with pytest.raises(ValueError, match="expected rising starts"):
        decide(form(one), [0], 40, mode)


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ({"mode": "on"}, "mode: expected None, online, offline, got 'on'"),
        ({"delay": -1}, "delay: expected at least 0, got -1"),
        ({"top": 0}, "top: expected at least 1, got 0"),
        ({"way": 0}, "way: expected 1 or -1, got 0"),
    ],
)
def test_a_wrong_argument_is_named(argument, said):
    with pytest.raises(ValueError, match=said):
        (follow if "way" in argument else decide)(np.zeros((3, 5)), [0], 5, **argument)


@pytest.mark.parametrize("name", ["candidates", "scores", "spread", "sample"])
def test_what_a_search_raises_is_raised(name):
    assert isinstance(Broken(name), Search)
    with pytest.raises(KeyError, match="the disk is gone"):
        decide(Broken(name), [0], 40)


@pytest.mark.parametrize(
    ("scores", "starts", "rows", "said"),
    [
        (np.full((3, 5), 2.0), [0], 5, "scores of at most 1, as cosines are, got 2"),
        (np.full((3, 5), np.nan), [0], 5, "scores of at most 1, as cosines are, got nan"),
        (np.zeros((3, 5)), [0], 4, r"scores: expected shape \(3, 4\), got \(3, 5\)"),
        (np.zeros((3, 5)), [0, 5], 5, "starts of drives among 5 rows, from 0, got 0, 5"),
        (np.zeros((3, 5)), [1], 5, "starts of drives among 5 rows, from 0, got 1"),
        (np.zeros((3, 5)), [0, 3, 3], 5, "starts of drives among 5 rows, from 0, got 0, 3, 3"),
        (np.zeros((3, 5)), [], 5, "starts of drives among 5 rows, from 0, got none"),
        (Best(np.zeros((3, 9), np.float32), 9), [0], 5, "candidates among 5 rows, got row"),
    ],
)
def test_refuses(scores, starts, rows, said):
    with pytest.raises(ValueError, match=said):
        decide(scores, starts, rows)


WITHOUT_TORCH = """
import sys
sys.modules |= dict.fromkeys(("torch", "kornia", "lance", "pyarrow", "yaml", "typer"))
import numpy as np
from ssrvlad_torch.native.decide import decide
print(decide(np.eye(40, dtype=np.float32)[10:30], [0], 40, top=1).rows[:, 0].tolist())
print(*sorted(name for name in sys.modules if name.startswith("ssrvlad_torch")))
"""


def test_decides_without_torch():
    _, (rows, modules), _ = outcome(sys.executable, "-c", WITHOUT_TORCH)
    assert rows == str([*range(10, 30)])
    names = ("", ".native", ".native.decide", ".native.headers")
    assert modules.split() == [f"ssrvlad_torch{name}" for name in names]
