"""Ground truth from poses and from frame numbers."""

import math

import numpy as np
import pytest
from helpers import refuses
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers, from_poses


def as_lists(truth):
    assert all(rows.dtype == np.int64 for rows in truth)
    return [rows.tolist() for rows in truth]


def test_the_distance_includes_its_limit_and_ignores_the_heading():
    references = np.array([[0, 0, 0], [3, 4, 1], [3, 4.01, 0], [-5, 0, 2]], float)
    queries = np.array([[0, 0, 9], [100, 0, math.nan]], float)
    assert as_lists(from_poses(queries, references, 5)) == [[0, 1, 3], []]
    assert as_lists(from_poses(queries, references, 0)) == [[0], []]
    assert as_lists(from_poses(queries, np.pad(references, ((0, 0), (0, 1))), 0)) == [[0], []]
    assert as_lists(from_poses(queries[:0], references, 5)) == []
    assert as_lists(from_poses(queries, references[:0], 5)) == [[], []]


def test_headings_are_compared_the_shorter_way_round():
    """Limits included; x and y are all alike. 359 and 2 degrees are 3 degrees apart."""
    there = np.radians([0, 10, 90, 180, 350, -90, 359])
    references = np.column_stack((np.zeros((7, 2)), there))
    here = np.radians([0, 2, 90 + 720, 270])
    queries = np.column_stack((np.zeros((4, 2)), here))
    expected = [[0, 1, 4, 6], [0, 1, 6], [2], [5]]
    assert as_lists(from_poses(queries, references, 1, degrees=10)) == expected
    assert as_lists(from_poses(queries[:1], references, 1, degrees=180)) == [[*range(7)]]
    assert as_lists(from_poses(queries[2:3], references, 1, degrees=0)) == [[2]]
    # both the distance and the heading count
    references = np.array([[0, 0, 0], [9, 0, 0], [0, 0, math.pi]])
    assert as_lists(from_poses(references[:1], references, 5, degrees=45)) == [[0]]


def test_queries_and_references_of_unknown_pose_are_left_out():
    known, holed = np.zeros((3, 3)), np.array([[math.nan, 0, 0], [0, 0, 0], [0, 0, math.nan]])
    assert [rows is None for rows in from_poses(holed, known, 5)] == [True, False, False]
    assert [rows is None for rows in from_poses(holed, known, 5, 9)] == [True, False, True]
    assert as_lists(from_poses(known[:1], holed, 5)) == [[1, 2]]
    assert as_lists(from_poses(known[:1], holed, 5, 9)) == [[1]]


def test_two_aligned_traverses_are_counted_apart():
    """In the order of names, whatever the order of the lists."""
    queries = ["night/10", "night/9", "night/11"]
    references = ["day/x3", "day/x1", "day/x2"]
    assert as_lists(from_frame_numbers(queries, references, 0)) == [[2], [1], [0]]
    assert as_lists(from_frame_numbers(queries, references, 1)) == [[0, 1, 2], [1, 2], [0, 2]]
    # a sequence may have slashes
    assert as_lists(from_frame_numbers(["a/b/1"], ["a/b/1", "a/c/1"], 9)) == [[0]]


POSE, UNKNOWN = np.zeros((1, 3)), np.full((2, 3), math.nan)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((POSE, POSE, -1), "0 metres or more"),
        ((POSE, POSE, math.nan), "0 metres or more"),
        ((POSE, POSE, math.inf), "0 metres or more and finite, got inf"),
        ((POSE, POSE, 1, -1), "0 degrees or more"),
        ((POSE, POSE, 1, math.nan), "0 degrees or more"),
        ((UNKNOWN, POSE, 1), "none of 2 queries has a pose; a tolerance in metres requires"),
        ((POSE, UNKNOWN, 1), "none of 2 references has a pose"),
        ((POSE, POSE[:, :2], 1, 9), "none of 1 references has a heading; a tolerance in degrees"),
        ((["a/1"], ["a/1"], -1), "0 frames or more, got -1"),
        ((["night/1"], ["day/1", "day/2"], 1), "length, got 1 query frames and 2 reference frames"),
        ((["night/1"], ["a/1", "b/1"], 1), r"query sequence 'night'.*\(a, b\)"),
        ((["a/1", "night/1"], ["a/1"], 1), r"query sequence 'night'.*\(a\)"),
        ((["a/1", "night/1"], ["a/1", "b/1"], 1), r"query sequence 'night'.*\(a, b\)"),
    ],
)
def test_wrong_tolerances_and_unaligned_traverses_are_refused(given, message):
    refuses(message, from_poses if isinstance(given[0], np.ndarray) else from_frame_numbers, *given)


FRAMES = st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 120)), min_size=1, unique=True)


@given(FRAMES, FRAMES, st.integers(0, 4))
@example([("a", 9), ("a", 3), ("a", 11)], [("a", n) for n in (2, 4, 6, 8, 10)], 1)  # 10 follows 9
@example([("a", 2)], [("a", 1), ("a", 2), ("a", 30)], 1)  # places, not numbers; itself
@example([("b", 1), ("a", 2)], [("a", 1), ("a", 2), ("b", 1), ("b", 2)], 0)
def test_frame_numbers_equal_a_loop(queries, references, reach):
    references += [("a", 1000), ("b", 1000)]
    drives = {name: sorted({n for s, n in queries + references if s == name}) for name in "ab"}
    expected = [
        [
            row
            for row, (there, number) in enumerate(references)
            if there == here
            and abs(drives[here].index(number) - drives[here].index(asked)) <= reach
        ]
        for here, asked in queries
    ]
    ids = [[f"{sequence}/{number}" for sequence, number in f] for f in (queries, references)]
    assert as_lists(from_frame_numbers(*ids, reach)) == expected
