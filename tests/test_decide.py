"""From scores to decisions: the core is held to `oracles.recognition`, and to itself."""

import core as single
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from oracles import recognition as oracle
from oracles.filter import Motion

from ssrvlad_torch.native.map import DescriptorMap, Shortlist
from ssrvlad_torch.recognition.recognise import BACKWARDS, Course
from ssrvlad_torch.recognition.sequences import SAME_PLACE_ROWS

pytestmark = pytest.mark.usefixtures("core")

TRACKS = {
    "as fast": list(range(20, 80)),
    "three times as fast": list(range(10, 160, 3)),
    "half as fast": [20 + i // 2 for i in range(80)],
    "with a stop": [*range(20, 50), *[50] * 20, *range(51, 80)],
    "with a jump": [*range(20, 60), *range(130, 170)],
}


def decide(scores, frames=None, mode="offline", delay=0, top=5, shortlist=None):
    """The decision by scores ``(Q, R)`` about a map of sequences of some frames."""
    town = DescriptorMap([scores.shape[1]] if frames is None else frames, shortlist)
    town.add("scores", None)
    return town.query({"scores": scores}, False, False, mode, delay, top)


def noisy(track, rows, seed=0, strength=0.25):
    """Scores in which the true row stands out only on average."""
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(len(track), rows, generator=generator) * 0.5
    scores[range(len(track)), track] += strength
    return scores.numpy()


def tracks(kind, queries, start):
    """The rows of a sequence, and of queries that are none."""
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
def sequences(draw, most=40):
    """Scores of queries, and the frames of each sequence of the map."""
    frames = draw(st.lists(st.integers(1, most), min_size=1, max_size=3))
    rows, queries = sum(frames), draw(st.integers(1, most))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    scores = rng.uniform(-0.2, 0.5, (queries, rows))
    kinds = ["forwards", "backwards", "fast", "slow", "two streams", "none"]
    track = tracks(draw(st.sampled_from(kinds)), queries, int(rng.integers(rows)))
    inside = (track >= 0) & (track < rows)
    scores[np.arange(queries)[inside], track[inside]] += draw(st.sampled_from((0.3, 0.5)))
    scores[:, rng.random(rows) < draw(st.sampled_from((0, 0.2)))] = -np.inf
    scores[rng.random(scores.shape) < draw(st.sampled_from((0, 0.1)))] = -np.inf
    scores[rng.random(queries) < draw(st.sampled_from((0, 0.1)))] = -np.inf
    return scores.astype(np.float32), frames


def names_of(frames):
    return [str(number) for number, count in enumerate(frames) for _ in range(count)]


def streams_of(decision, scores):
    """The queries of each stream of the course that was taken."""
    return [np.arange(number, len(scores), decision.streams) for number in range(decision.streams)]


@given(sequence=sequences(), top=st.integers(1, 6))
def test_a_query_alone_has_the_best_rows_and_the_confidence_of_the_oracle(sequence, top):
    scores, frames = sequence
    decision = decide(scores, frames, None, top=top)
    answered = np.isfinite(scores).any(1)
    best = np.argsort(-scores, axis=1, kind="stable")[:, :top]
    values = np.take_along_axis(scores, best, 1)
    shape = decision.rows[:, : best.shape[1]]
    np.testing.assert_array_equal(shape, np.where(np.isfinite(values), best, -1))
    judged = [oracle.chance(oracle.nearness(row)) for row in scores]
    chances = np.where(answered, [chance for chance, _ in judged], np.nan)
    rivals = oracle.rivals_together(chances, [rival for _, rival in judged])
    together = oracle.answers_together(rivals)
    right, spread = oracle.confidence(chances, oracle.mapped(chances, together), together)
    enough = sum(frames) >= oracle.MIN_FRAMES
    np.testing.assert_allclose(decision.right, right * enough, atol=1e-6)
    np.testing.assert_allclose(decision.spread, spread, atol=1e-6)
    np.testing.assert_allclose(decision.together, together, rtol=1e-6)


@given(sequence=sequences())
@settings(max_examples=60)
def test_a_followed_sequence_has_the_beliefs_of_forward_and_backward(sequence):
    scores, frames = sequence
    rows, names = sum(frames), names_of(frames)
    decision = decide(scores, frames, top=rows)
    if not decision.followed:
        return
    motion = Motion().at(decision.rate)
    for stream in streams_of(decision, scores):
        beliefs = oracle.follow(scores[stream], names, motion, decision.way)
        for query, belief in zip(stream, beliefs, strict=True):
            places = decision.rows[query][decision.rows[query] >= 0]
            values = belief[places]
            if len(places):
                beside = np.abs(np.arange(rows) - places[0]) <= SAME_PLACE_ROWS
                values[0] = belief[beside & (np.array(names) == names[places[0]])].sum()
            np.testing.assert_allclose(decision.scores[query][: len(places)], values, atol=2e-5)


@given(sequence=sequences())
@settings(max_examples=40)
def test_the_gain_of_a_course_is_that_of_the_oracle(sequence):
    scores, frames = sequence
    decision = decide(scores, frames)
    if not decision.gain:
        return
    motion = Motion(rate=decision.rate)
    gain = sum(
        oracle.gain(scores[stream], names_of(frames), motion, decision.way)
        for stream in streams_of(decision, scores)
    )
    gain *= 0.75 if decision.streams == 2 else 1
    assert decision.gain == pytest.approx(gain / len(scores), abs=1e-5)


@given(sequence=sequences())
@settings(max_examples=30)
def test_a_shortlist_of_all_rows_decides_as_all_rows_do(sequence):
    scores, frames = sequence
    rows = np.arange(sum(frames))
    starts = np.cumsum([0, *frames[:-1]])
    listed = decide(scores, frames, shortlist=Shortlist(rows, np.ones(len(rows)), starts))
    whole = decide(scores, frames)
    np.testing.assert_array_equal(listed.rows, whole.rows)
    for name in ("scores", "right", "spread", "together"):
        np.testing.assert_allclose(getattr(listed, name), getattr(whole, name), atol=1e-5)


@given(sequence=sequences())
@settings(max_examples=40)
def test_a_map_in_reverse_mirrors_the_way(sequence):
    scores, frames = sequence
    decision = decide(scores, frames)
    mirror = decide(np.ascontiguousarray(scores[:, ::-1]), frames[::-1])
    if (
        decision.gain < 0.1 or decision.gain * len(scores) < 5
    ):  # near the limits forwards is likelier
        return
    assert (mirror.way, mirror.rate) == (-decision.way, decision.rate)
    if decision.followed and mirror.followed:
        first, other = decision.rows[:, 0], sum(frames) - 1 - mirror.rows[:, 0]
        assert np.mean((first == other) | (first < 0)) > 0.9


def test_a_query_of_scores_that_are_equal_but_for_rounding_says_nothing():
    scores = noisy([*range(5, 45)], 80)
    scores[8] = -0.5
    rounded = scores.copy()
    rounded[8] += np.random.default_rng(0).uniform(-1e-6, 1e-6, 80)
    equal, nearly = decide(scores), decide(rounded)
    assert equal.followed
    np.testing.assert_allclose(nearly.scores, equal.scores, atol=1e-5)


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
    decision = decide(noisy([*track], ROWS, strength=0.5))
    course = Course(decision.way, decision.rate, decision.streams)
    assert course == (expected or Course()) and (decision.gain > 0) == (expected is not None)
    if expected:
        right = np.abs(decision.rows[:, 0] - np.array(track)) <= SAME_PLACE_ROWS
        assert decision.followed and right.mean() > 0.9


def test_a_course_that_trailed_at_first_may_win():
    decision = decide(noisy([*range(120, 150), *range(150, 50, -1)], ROWS, strength=0.5))
    assert decision.way == BACKWARDS


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


def test_answers_that_linger_where_the_map_has_a_hole_are_not_believed():
    queries, whole = np.arange(20, 120), np.arange(150)
    decision = decide(seen_in_a_street(queries, whole))
    assert decision.followed and decision.right.mean() > 0.95
    lacking = decide(seen_in_a_street(queries, whole[(whole < 60) | (whole >= 70)]))
    assert lacking.followed and lacking.right[43:47].mean() < 0.05
    assert lacking.right[:36].mean() > 0.95 and lacking.right[56:].mean() > 0.95


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_answers_of_a_sequence_that_stands_linger_rightly(mode):
    stops = np.array([*range(20, 60), *[60] * 30, *range(61, 110)])
    decision = decide(seen_in_a_street(stops, np.arange(150)), mode=mode)
    assert decision.followed and decision.right[42:68].mean() > 0.9


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_answers_of_a_sequence_denser_than_the_map_do_not_linger(mode):
    """Ten frames a row, along places of which the map has every tenth."""
    rng = np.random.default_rng(1)
    street = rng.normal(size=(1400, 64))
    street = sum(np.roll(street, place, 0) for place in range(50)) / 7
    here = torch.from_numpy(street[300:900] + 0.5 * rng.normal(size=(600, 64)))
    there = torch.from_numpy(street[::10] + 0.5 * rng.normal(size=(140, 64)))
    decision = decide(torch.cosine_similarity(here[:, None], there, 2).float().numpy(), mode=mode)
    assert decision.followed and decision.right[20:].mean() > 0.9


def test_a_long_sequence_computes_beliefs_again_with_the_same_places():
    """Of a map whose beliefs are too many to be kept."""
    scores = noisy([*range(5000, 5050)], 60_000, strength=0.4)
    assert scores.size * 7 > 1 << 24
    whole = decide(scores, [20_000, 40_000])
    few = decide(np.ascontiguousarray(scores[:, 4000:6000]))
    assert whole.rows[:, 0].tolist() == (few.rows[:, 0] + 4000).tolist() == [*range(5000, 5050)]


@pytest.mark.parametrize(("mode", "delay"), [("offline", 0), ("online", 3)])
def test_frames_that_equal_their_rows_in_a_large_map_are_followed(mode, delay):
    """The likelihood of two neighbouring frames is more than single precision holds."""
    rows = np.r_[:120, 1000:300_000:1500]
    shortlist = Shortlist(rows, np.where(rows < 120, 1.0, 1500.0), np.array([0]))
    scores = np.zeros((40, len(rows)), np.float32)
    track = np.arange(50, 90)
    scores[range(40), track] = 1
    got = decide(scores, [300_000], mode, delay, shortlist=shortlist)
    assert got.followed and (got.rows[:, 0] == track).all()


def test_few_rows_give_no_confidence():
    scores = noisy([*range(5, 25)], 29, strength=0.5)
    assert not decide(scores).right.any()
    assert decide(np.pad(scores, ((0, 0), (0, 1)))).right.any()


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (0, 0)])
def test_no_queries_and_no_rows_give_no_candidates(shape):
    decision = decide(np.zeros(shape, np.float32), [shape[1]] if shape[1] else [], top=2)
    assert decision.rows.shape == (shape[0], 2) and (decision.rows == -1).all()
    assert not decision.right.any() and not decision.followed


@pytest.mark.parametrize("mode", ["online", "offline"])
@pytest.mark.parametrize("rows", [100, 10_000])
def test_nothing_is_sure_where_a_map_lacks_all_places(rows, mode):
    """Whatever its size: how near chance places are does not grow with it."""
    for seed in range(3):
        drawn = np.random.default_rng(seed).normal(size=(83, rows + 4))
        near = sliding_window_view(drawn, (4, 5)).mean((2, 3))  # neighbours are alike
        decision = decide((1 - np.exp(-0.3 - 0.2 * near)).astype(np.float32), mode=mode)
        assert decision.right.max() < 0.9


@pytest.mark.parametrize("score", [np.nan, np.inf, 5.0])
@pytest.mark.parametrize("mode", [None, "online", "offline"])
def test_scores_that_are_no_cosines_are_refused(score, mode):
    scores = np.zeros((2, 40), np.float32)
    scores[0, 3] = score
    with pytest.raises(ValueError, match="expected scores of at most"):
        decide(scores, mode=mode)


@given(
    seed=st.integers(0, 1000),
    queries=st.sampled_from((1, 7, 25)),
    right=st.sampled_from((0, 0.5, 1)),
    followed=st.booleans(),
)
def test_what_the_map_has_and_confidence_are_those_of_the_oracle(seed, queries, right, followed):
    rng = np.random.default_rng(seed)
    is_right, empty = rng.random(queries) < right, rng.random(queries) < 0.1
    chances = np.where(is_right, rng.random(queries) ** 6, rng.random(queries))
    nearer = rng.normal(np.where(is_right, 4, 1.9), rng.choice([1, 5]))
    chances[empty] = nearer[empty] = np.nan
    rivals = np.sort(rng.integers(0, 100, queries))
    lengths = oracle.rivals_together(chances, rivals)
    np.testing.assert_array_equal(single.rivals_together(chances, rivals), lengths)
    together = oracle.answers_together(lengths)
    has, of_core = (
        side.mapped_along(nearer, lengths) if followed else side.mapped(chances, together)
        for side in (oracle, single)
    )
    np.testing.assert_allclose(of_core, has, atol=1e-9)
    of_core, expected = (
        side.confidence(chances, has, together, followed) for side in (single, oracle)
    )
    np.testing.assert_allclose(of_core, expected, atol=1e-6)
