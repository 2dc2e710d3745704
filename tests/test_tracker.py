"""The tracker: a sequence in a known map, frame by frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_streams import unit
from oracles import recognition as oracle
from test_decide import decide, noisy

from ssrvlad_torch.native.map import DescriptorMap
from ssrvlad_torch.native.tracker import DescriptorTracker

pytestmark = pytest.mark.usefixtures("core")

ROWS, QUERIES, FIRST = [33, 67, 40], 70, 40
FIELDS = ("scores", "rows", "right", "spread", "together", "follows")
BEFORE = 10
"""Frames like the mean of the map that are added to the mean of a sequence."""


def town_and_queries(seed=0, strength=0.5):
    """A map of vectors and signs, and a sequence along its rows that sees them changed."""
    rng = np.random.default_rng(seed)
    rows = unit(rng.normal(size=(sum(ROWS), 48)))
    signs = rng.integers(0, 256, (sum(ROWS), 6, 2, 8), dtype=np.uint8)
    here = slice(FIRST, FIRST + QUERIES)
    noise = strength * rng.normal(size=(QUERIES, 3, 48)) / np.sqrt(48)
    flips = rng.integers(0, 256, (2, QUERIES, 6, 2, 8), dtype=np.uint8)
    queries = {"v": unit(rows[here, None] + noise), "s": signs[here] ^ flips[0] & flips[1]}
    town = DescriptorMap(ROWS)
    town.add("v", rows)
    town.add("s", signs, 6.0)
    return town, queries


def tracked(tracker, queries, rows=range(QUERIES)):
    """The decisions about queries, by their numbers."""
    answers = [
        tracker.update({name: array[row] for name, array in queries.items()}) for row in rows
    ]
    return dict([answer for answer in answers if answer] + tracker.finish())


def equal(decision, answers):
    for name in FIELDS:
        values = [getattr(answer, name) for _, answer in sorted(answers.items())]
        np.testing.assert_array_equal(np.concatenate(values), getattr(decision, name))


@pytest.mark.parametrize("delay", [0, 3, 12])
@pytest.mark.parametrize("strength", [0.5, 3.0])
def test_online_is_the_tracker_run_over_a_sequence(delay, strength):
    town, queries = town_and_queries(strength=strength)
    decision = town.query(queries, follow="online", delay=delay, top=3)
    answers = tracked(DescriptorTracker(town, delay=delay, top=3), queries)
    assert [*answers] == [*range(QUERIES)]
    equal(decision, answers)


@given(
    seed=st.integers(0, 1000), length=st.integers(1, QUERIES), delay=st.sampled_from((0, 1, 5, 30))
)
@settings(max_examples=20)
def test_an_answer_never_depends_on_frames_later_than_its_delay(seed, length, delay):
    town, queries = town_and_queries(seed, 2.0)
    whole = town.query(queries, follow="online", delay=delay)
    first = town.query(
        {n: array[:length] for n, array in queries.items()}, follow="online", delay=delay
    )
    known = max(0, length - delay)
    for name in FIELDS:
        np.testing.assert_array_equal(
            getattr(whole, name)[:known], getattr(first, name)[:known], err_msg=name
        )


@pytest.mark.parametrize("stop", [0, 1, 20, 45])
def test_saving_and_going_on_changes_no_bit(stop):
    town, queries = town_and_queries(strength=2.0)
    tracker = DescriptorTracker(town, delay=4, top=3)
    rows = [{name: array[row] for name, array in queries.items()} for row in range(QUERIES)]
    answers = [tracker.update(row) for row in rows[:stop]]
    other = DescriptorTracker(town, delay=4, top=3)
    other.load(tracker.save())
    answers += [other.update(row) for row in rows[stop:]]
    equal(
        town.query(queries, follow="online", delay=4, top=3),
        dict([answer for answer in answers if answer] + other.finish()),
    )


def test_a_tracker_reads_all_rows_of_its_map_for_one_state_alone():
    """Seen by rows that are changed, which a map does not allow."""
    rows = np.eye(40, dtype=np.float32)
    town = DescriptorMap([40])
    town.add("v", rows)
    tracker = DescriptorTracker(town)
    tracker.update({"v": rows[5].copy()})
    first = tracker.save()
    tracker.update({"v": np.zeros(40, np.float32)})
    second = tracker.save()
    rows[7] = 0
    unread = DescriptorTracker(town)
    with pytest.raises(ValueError, match="this map"):
        unread.load(first)
    tracker.update({"v": np.zeros(40, np.float32)})
    assert tracker.save()[-24:-16] == second[-24:-16] == first[-24:-16]


def test_a_state_is_that_of_the_last_query():
    town, queries = town_and_queries()
    tracker, states = DescriptorTracker(town, delay=2), []
    for row in range(3):
        tracker.update({name: array[row] for name, array in queries.items()})
        states.append(tracker.save())
        assert tracker.save() == states[-1]
    tracker.finish()
    states.append(tracker.save())
    for state, count, waiting in zip(states, (1, 2, 3, 3), (1, 2, 2, 0), strict=True):
        other = DescriptorTracker(town, delay=2)
        other.load(state)
        assert (other.count, len(other.finish())) == (count, waiting)


def test_a_state_is_of_its_map_and_its_settings_and_whole():
    town, queries = town_and_queries()
    tracker = DescriptorTracker(town)
    tracked(tracker, queries, range(5))
    state = tracker.save()
    smaller = DescriptorMap([30])
    smaller.add("v", np.eye(30, 48, dtype=np.float32))
    smaller.add("s", np.zeros((30, 6, 2, 8), np.uint8), 6.0)
    changed = DescriptorMap(ROWS)
    changed.add("v", np.eye(sum(ROWS), 48, dtype=np.float32))
    changed.add("s", np.zeros((sum(ROWS), 6, 2, 8), np.uint8), 6.0)
    damaged = bytearray(state)
    damaged[len(state) // 2] ^= 1
    for other, content, expected in (
        (DescriptorTracker(smaller), state, "this map"),
        (DescriptorTracker(changed), state, "this map"),
        (DescriptorTracker(town, allowed=np.arange(sum(ROWS)) > 50), state, "these steps"),
        (DescriptorTracker(town, delay=1), state, "these steps"),
        (DescriptorTracker(town, sweep=False), state, "these steps"),
        (DescriptorTracker(town), state[:-9], "a whole state"),
        (DescriptorTracker(town), bytes(damaged), "a whole state"),
        (DescriptorTracker(town), b"", "a whole state"),
        (tracker, state, "a tracker that has taken no frame"),
    ):
        with pytest.raises(ValueError, match=f"expected .*{expected}"):
            other.load(content)


def test_only_rows_that_are_allowed_are_candidates():
    """Long after the caller has let the mask go, from the first answer on."""
    rows = 100_000
    town = DescriptorMap([rows])
    town.add("v", np.ones((rows, 2), np.float32) / np.float32(np.sqrt(2)))
    tracker = DescriptorTracker(town, allowed=np.arange(rows) >= rows - 8)
    others = [np.full(rows, number, np.uint8) for number in range(20)]  # take freed memory
    _, decision = tracker.update({"v": np.ones(2, np.float32)})
    assert others and decision.rows.min() >= rows - 8


@pytest.mark.parametrize("kind", ["vectors", "signs"])
@given(seed=st.integers(0, 1000))
@settings(max_examples=10)
def test_rows_lose_the_mean_of_the_queries_so_far_and_of_ten_frames_like_the_map(kind, seed):
    """Judged alone, the score of the first candidate is its cosine."""
    rng = np.random.default_rng(seed)
    if kind == "vectors":
        rows, queries = (unit(rng.normal(size=(count, 32)) + 0.5) for count in (80, 12))
        there, here = rows, queries
    else:
        rows, queries = (rng.integers(0, 256, (n, 4, 2, 4), dtype=np.uint8) | 1 for n in (80, 12))
        there, here = (
            2.0 * np.unpackbits(signs.reshape(len(signs), -1), axis=1) - 1
            for signs in (rows, queries)
        )
    town = DescriptorMap([50, 30])
    town.add("x", rows)
    decision = town.query({"x": queries}, sweep=False, follow="online", top=80)
    sides = np.concatenate([part - part.mean(0) for part in (there[:50], there[50:])])
    assert not decision.follows.all()
    for query in np.flatnonzero(~decision.follows):
        total = here[: query + 1].sum(0) + BEFORE * there.mean(0)
        expected = oracle.cosines((here[query] - total / (query + 1 + BEFORE))[None], sides)[0]
        scores = np.empty(80)
        scores[decision.rows[query]] = decision.scores[query]
        np.testing.assert_allclose(scores, expected, atol=2e-6)


@pytest.mark.parametrize("delay", [0, 10])
@pytest.mark.parametrize(
    "track",
    [[*range(40, 140)], [*range(140, 40, -1)], [*range(10, 190, 3)], [*range(20, 50), *[50] * 20]],
)
def test_a_sequence_is_found_better_than_its_frames_alone(track, delay):
    scores = noisy(track, 200, strength=0.4)
    followed, alone = decide(scores, mode="online", delay=delay), decide(scores, mode=None)
    near = [np.abs(decision.rows[:, 0] - track) <= 1 for decision in (followed, alone)]
    assert near[0].mean() > near[1].mean() + 0.05 and followed.follows.any()
    assert followed.right[near[0]].mean() > 0.5


def test_frames_in_no_order_are_judged_alone():
    track = np.random.default_rng(0).permutation(200)[:100]
    scores = noisy([*track], 200, strength=0.5)
    followed, alone = decide(scores, mode="online"), decide(scores, mode=None)
    assert followed.follows.mean() < 0.1
    np.testing.assert_array_equal(followed.rows[~followed.follows], alone.rows[~followed.follows])


def test_a_followed_query_is_near_what_forward_and_backward_over_the_same_frames_say():
    """At the end of the sequence, where both know the same."""
    scores = noisy([*range(40, 140)], 200, strength=0.4)
    online, offline = (decide(scores, mode=mode) for mode in ("online", "offline"))
    assert online.followed and offline.followed
    assert online.rows[-1, 0] == offline.rows[-1, 0]
    np.testing.assert_allclose(online.scores[-1, 0], offline.scores[-1, 0], atol=0.02)


def test_excluded_rows_are_no_candidates_of_their_query():
    town, queries = town_and_queries()
    excluded = np.tile([0, 0], (QUERIES, 1))
    excluded[30] = FIRST + 25, FIRST + 35
    decision = town.query(queries, follow="online", excluded=excluded)
    assert not ((decision.rows[30] >= FIRST + 25) & (decision.rows[30] < FIRST + 35)).any()
    assert (decision.rows[31:, 0] == FIRST + np.arange(31, QUERIES)).mean() > 0.9


def test_other_anchors_than_those_of_the_first_query_are_refused():
    town, queries = town_and_queries()
    tracker = DescriptorTracker(town)
    tracker.update({"v": queries["v"][0], "s": queries["s"][0]})
    with pytest.raises(ValueError, match="expected as many anchors of each query"):
        tracker.update({"v": queries["v"][1, :1], "s": queries["s"][1]})
