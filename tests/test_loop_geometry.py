"""Keypoints that agree up to a shift: by hand, and against counting every pair."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssrvlad_torch.loops.geometry import SharedKeypoints, shared_keypoints
from ssrvlad_torch.loops.sighting import Sighting


def points(*rows):
    return np.array(rows, np.int16).reshape(-1, 3)


SQUARE = points((0, 10, 10), (0, 10, 20), (1, 20, 10), (2, 20, 20))


def test_a_frame_shares_all_with_itself():
    assert shared_keypoints(SQUARE, SQUARE, 3) == 1


@pytest.mark.parametrize(("shift", "share"), [((0, 3), 1), ((-3, 2), 1), ((3, 4), 0), ((5, 0), 0)])
def test_a_shift_of_the_camera_is_found_if_it_is_small(shift, share):
    """Up to three pixels each way."""
    assert shared_keypoints(SQUARE, SQUARE + np.array([0, *shift], np.int16), 3) == share


def test_points_of_other_categories_do_not_agree():
    other = SQUARE.copy()
    other[:, 0] += 3
    assert shared_keypoints(SQUARE, other, 3) == 0


def test_two_points_that_moved_apart_do_not_agree_on_a_shift():
    """Both move by three pixels, one to the left and one to the right."""
    here, there = points((0, 10, 10), (0, 30, 10)), points((0, 10, 7), (0, 30, 13))
    assert shared_keypoints(here, there, 5) == 0.5
    assert shared_keypoints(here, points((0, 10, 9), (0, 30, 11)), 5) == 1


def test_the_share_is_that_of_the_smaller_set():
    assert shared_keypoints(SQUARE, SQUARE[:1], 3) == 1
    assert shared_keypoints(SQUARE, points((0, 10, 10), (5, 0, 0)), 3) == 0.5


def test_without_key_points_nothing_is_shared():
    assert shared_keypoints(points(), SQUARE, 3) == shared_keypoints(points(), points(), 3) == 0


def test_the_check_lets_frames_through_whose_key_points_are_not_known():
    def sighting(keypoints):
        return Sighting("drive/0", np.zeros(3), 0.0, keypoints)

    check = SharedKeypoints(share=0.6)
    assert check(sighting(SQUARE), sighting(SQUARE[:2]))
    assert not check(sighting(SQUARE), sighting(points((0, 10, 10), (5, 0, 0))))
    assert not check(sighting(SQUARE), sighting(points()))
    assert check(sighting(None), sighting(SQUARE))
    assert check(sighting(SQUARE), sighting(None))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 9), st.integers(0, 9), st.integers(0, 4), st.integers(0, 2**31))
def test_the_share_equals_a_count_of_all_pairs(first, second, shift, seed):
    rng = np.random.default_rng(seed)
    here, there = (
        rng.integers((0, 0, 0), (2, 8, 8), (n, 3)).astype(np.int16) for n in (first, second)
    )
    most = 0
    for down in range(-shift, shift + 1):
        for right in range(-shift, shift + 1):
            most = max(
                most,
                sum(
                    a[0] == b[0]
                    and abs(a[1] - b[1] - down) <= 1
                    and abs(a[2] - b[2] - right) <= 1
                    and max(abs(a[1] - b[1]), abs(a[2] - b[2])) <= shift
                    for a in here.tolist()
                    for b in there.tolist()
                ),
            )
    assert shared_keypoints(here, there, shift) == most / max(1, min(first, second))
