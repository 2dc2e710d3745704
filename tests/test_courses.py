"""`recognition.courses`: whether queries run a map, and how, against sequences that are none."""

import numpy as np
import pytest
from test_follow import TRACKS, noisy

from ssrvlad_torch.recognition.courses import Course, course, is_followed
from ssrvlad_torch.recognition.evidence import AllRows
from ssrvlad_torch.recognition.motion import BACKWARDS

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
    scores = noisy([*track], ROWS, strength=0.5)
    found = course(AllRows(scores, ["map"] * ROWS))
    assert (found and found[0]) == expected


def test_a_map_in_another_order_is_run_by_hardly_anything():
    scores = noisy([*range(60)], ROWS, strength=0.5)
    found = course(AllRows(scores[:, RANDOM.permutation(ROWS)], ["map"] * ROWS))
    assert found is None or found[1] < 0.1
    assert course(AllRows(scores, ["map"] * ROWS))[1] > 0.5


def test_a_drive_is_followed_unless_that_is_less_sure_and_others_if_it_is_surer():
    assert is_followed(0.8, 0.9, 0.9) and not is_followed(0.8, 0.8, 0.9)
    assert is_followed(0.1, 0.4, 0.3) and not is_followed(0.1, 0.32, 0.3)


def test_a_course_in_words():
    assert str(Course()) == ""
    assert str(Course(BACKWARDS, 3, 2)) == "backwards, at rate 3, 2 streams in turn"
    assert Course(streams=2).parts(range(1, 6)) == [range(1, 6, 2), range(2, 6, 2)]
