"""The growing map: equal to Eq. 3 offline, bit by bit; growth; reading while it grows."""

import threading

import numpy as np
import pytest
import torch
from helpers import descriptors
from hypothesis import given, settings
from hypothesis import strategies as st

from ssrvlad_torch import match
from ssrvlad_torch.loops.memory import BLOCK_ROWS, GrowingArray, OnlineMemory
from ssrvlad_torch.recognition.matching import temporal_sum

LENGTH = 24


def stream(lengths, seed=0, width=LENGTH, empty=0.2):
    """Ids of drives of so many frames each, and descriptors of which some are zero."""
    ids = [f"drive {n}/{i:04d}" for n, length in enumerate(lengths) for i in range(length)]
    vectors = descriptors(seed, len(ids), width)
    vectors[torch.from_numpy(np.random.default_rng(seed).random(len(ids)) < empty)] = 0
    return ids, vectors.numpy()


def fed(ids, vectors, reach, width=LENGTH):
    memory = OnlineMemory(width, reach)
    for frame, vector in zip(ids, vectors, strict=True):
        memory.append(frame, vector)
    return memory


def offline(ids, vectors, reach):
    return temporal_sum(vectors, [frame.rpartition("/")[0] for frame in ids], reach).numpy()


def assert_same_bits(got, wanted):
    assert got.dtype == wanted.dtype == np.float32
    np.testing.assert_array_equal(got.view(np.uint32), wanted.view(np.uint32))


drives = st.lists(st.integers(1, 9), min_size=1, max_size=4)
reaches = st.integers(0, 5)
seeds = st.integers(0, 2**31)


@settings(max_examples=80, deadline=None)
@given(drives, reaches, seeds)
def test_the_map_is_the_temporal_sum_bit_by_bit(lengths, reach, seed):
    ids, vectors = stream(lengths, seed)
    memory = fed(ids, vectors, reach)
    memory.end_sequence()
    assert memory.snapshot.frames == ids
    assert_same_bits(memory.snapshot.descriptors, offline(ids, vectors, reach))


@pytest.mark.parametrize("count", [1, 7, 500, 3000])
def test_the_map_is_the_temporal_sum_bit_by_bit_at_full_width(count):
    """The offline sum runs over matrices of any size; none may round otherwise."""
    ids, vectors = stream([count], width=480)
    memory = fed(ids, vectors, 3, width=480)
    memory.end_sequence()
    assert_same_bits(memory.snapshot.descriptors, offline(ids, vectors, 3))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 12), reaches, seeds)
def test_at_every_moment_the_map_is_the_beginning_of_the_whole(length, reach, seed):
    """It lacks the last t frames, and what it has is final."""
    ids, vectors = stream([length], seed)
    whole = offline(ids, vectors, reach)
    memory = OnlineMemory(LENGTH, reach)
    for count, (frame, vector) in enumerate(zip(ids, vectors, strict=True), 1):
        memory.append(frame, vector)
        rows = max(0, count - reach)
        assert (memory.snapshot.rows, len(memory)) == (rows, count)
        if rows:
            assert_same_bits(memory.snapshot.descriptors, whole[:rows])


@settings(max_examples=60, deadline=None)
@given(drives, drives, reaches, seeds)
def test_made_in_one_go_it_goes_on_in_the_same_way(lengths, more, reach, seed):
    ids, vectors = stream(lengths + more, seed)
    here = sum(lengths) - lengths[-1] // 2
    at_once = OnlineMemory.of_frames(ids[:here], vectors[:here], reach)
    one_by_one = fed(ids[:here], vectors[:here], reach)
    for frame, vector in zip(ids[here:], vectors[here:], strict=True):
        assert at_once.snapshot.frames == one_by_one.snapshot.frames
        for memory in (at_once, one_by_one):
            memory.append(frame, vector)
    for memory in (at_once, one_by_one):
        memory.end_sequence()
    assert_same_bits(at_once.snapshot.descriptors, one_by_one.snapshot.descriptors)
    np.testing.assert_array_equal(at_once.snapshot.empty, one_by_one.snapshot.empty)


def test_made_of_no_frames_it_is_empty():
    memory = OnlineMemory.of_frames([], np.zeros((0, LENGTH), np.float32), 2)
    assert (len(memory), memory.snapshot.rows, memory.snapshot.frames) == (0, 0, [])
    assert memory.snapshot.descriptors.shape == (0, LENGTH)


def test_a_sequence_that_is_ended_does_not_reach_into_the_next_of_its_name():
    ids, vectors = stream([4], empty=0)
    memory = fed(ids[:2], vectors[:2], 1)
    memory.end_sequence()
    for frame, vector in zip(ids[2:], vectors[2:], strict=True):
        memory.append(frame, vector)
    memory.end_sequence()
    wanted = temporal_sum(vectors, ["before", "before", "after", "after"], 1).numpy()
    assert_same_bits(memory.snapshot.descriptors, wanted)


def test_a_hand_worked_sum():
    """Three frames at right angles and t = 1: half of the first two, a third of all."""
    memory = fed(["a/0", "a/1", "a/2"], np.eye(3, dtype=np.float32), 1, width=3)
    assert memory.snapshot.rows == 2
    np.testing.assert_allclose(
        memory.snapshot.descriptors, [[0.5**0.5, 0.5**0.5, 0], [3**-0.5] * 3], rtol=1e-6
    )


def test_blocks_do_not_show(monkeypatch):
    ids, vectors = stream([25], empty=0.3)
    query = vectors[next(i for i, v in enumerate(vectors) if v.any())]
    whole = fed(ids, vectors, 0).snapshot
    monkeypatch.setattr("ssrvlad_torch.loops.memory.BLOCK_ROWS", 4)
    parts = fed(ids, vectors, 0).snapshot
    assert (len(whole.blocks), len(parts.blocks)) == (1, 7)
    assert_same_bits(parts.descriptors, whole.descriptors)
    np.testing.assert_allclose(parts.scores(query), whole.scores(query), rtol=0, atol=1e-6)


def test_scores_are_cosines_and_an_empty_frame_has_none():
    ids, vectors = stream([30], empty=0.3)
    snapshot = fed(ids, vectors, 0).snapshot
    query = descriptors(9, 1, LENGTH).numpy()[0]
    wanted = np.where(vectors.any(axis=1), vectors @ query, -np.inf)
    assert np.isneginf(wanted).any()
    np.testing.assert_allclose(snapshot.scores(query), wanted, rtol=0, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 50), seeds)
def test_search_finds_what_match_finds(count, top, seed):
    ids, vectors = stream([count], seed, empty=0.3)
    query = descriptors(seed + 1, 1, LENGTH).numpy()
    found = fed(ids, vectors, 0).snapshot.search(query[0], top)
    scores, rows = match(query, vectors, top)
    known = rows[0] >= 0
    assert [frame for frame, _ in found] == [ids[row] for row in rows[0][known].tolist()]
    np.testing.assert_allclose([s for _, s in found], scores[0][known].numpy(), atol=1e-6)


def test_growing_copies_no_descriptor():
    """Blocks stay where they are; only room for the next is added."""
    ids, vectors = stream([2 * BLOCK_ROWS + 1])
    memory = OnlineMemory(LENGTH, 0)
    seen = {}
    for frame, vector in zip(ids, vectors, strict=True):
        memory.append(frame, vector)
        for number, block in enumerate(memory.snapshot.blocks):
            assert seen.setdefault(number, block) is block
    assert len(seen) == 3


def test_an_array_that_grows_keeps_its_rows_and_old_views():
    array = GrowingArray([("number", np.int64), ("pair", np.float64, 2)])
    views = []
    for number in range(100):
        array.append((number, (number, -number)))
        views.append(array.values["number"])
    assert len(array) == 100
    assert array.values["pair"].tolist() == [[n, -n] for n in range(100)]
    for count, view in enumerate(views, 1):
        assert view.tolist() == list(range(count))


def test_a_snapshot_stays_as_it_was():
    ids, vectors = stream([300])
    memory = fed(ids[:100], vectors[:100], 1)
    snapshot = memory.snapshot
    before = snapshot.descriptors, snapshot.frames, snapshot.empty.copy()
    for frame, vector in zip(ids[100:], vectors[100:], strict=True):
        memory.append(frame, vector)
    assert_same_bits(snapshot.descriptors, before[0])
    assert (snapshot.frames, snapshot.empty.tolist()) == (before[1], before[2].tolist())
    assert memory.snapshot.rows == 299


def test_many_read_while_one_writes(monkeypatch):
    """Every snapshot that a reader gets is, whole and exact, a beginning of the final map."""
    monkeypatch.setattr("ssrvlad_torch.loops.memory.BLOCK_ROWS", 16)
    ids, vectors = stream([400, 300, 1300])
    whole = offline(ids, vectors, 2)
    memory, done, errors, sizes = OnlineMemory(LENGTH, 2), threading.Event(), [], set()

    def read(seed):
        rng = np.random.default_rng(seed)
        try:
            while not done.is_set():
                snapshot = memory.snapshot
                sizes.add(snapshot.rows)
                assert snapshot.frames == ids[: snapshot.rows]
                if snapshot.rows:
                    assert_same_bits(snapshot.descriptors, whole[: snapshot.rows])
                    row = rng.integers(snapshot.rows)
                    expected = 1 if whole[row].any() else -np.inf
                    assert snapshot.scores(whole[row])[row] == pytest.approx(expected, abs=1e-5)
        except BaseException as error:
            errors.append(error)
            raise

    readers = [threading.Thread(target=read, args=(seed,)) for seed in range(4)]
    for reader in readers:
        reader.start()
    for frame, vector in zip(ids, vectors, strict=True):
        memory.append(frame, vector)
    memory.end_sequence()
    done.set()
    for reader in readers:
        reader.join()
    assert not errors
    assert len(sizes) > 1
    assert_same_bits(memory.snapshot.descriptors, whole)


@pytest.mark.slow
def test_a_hundred_thousand_frames_are_the_temporal_sum_bit_by_bit():
    """Many times the room of a block, and past every doubling of what doubles."""
    ids, vectors = stream([70_000, 30_000], empty=0.01)
    memory = fed(ids, vectors, 3)
    memory.end_sequence()
    assert len(memory.snapshot.blocks) == -(-100_000 // BLOCK_ROWS)
    assert_same_bits(memory.snapshot.descriptors, offline(ids, vectors, 3))
    np.testing.assert_array_equal(memory.snapshot.empty, ~vectors.any(axis=1))
