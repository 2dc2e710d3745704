"""How the camera of queries differs from that of a map, on cells of random signs."""

import numpy as np
import pytest

from ssrvlad_torch.channels.camera import Camera, camera_of

CELLS, PAIRS = 16, 12


def scenes():
    """Cells around and inside of pictures, ``(PAIRS, 22, 22, 4)``."""
    return np.random.default_rng(0).integers(0, 256, (PAIRS, CELLS + 6, CELLS + 6, 4), np.uint8)


def picture(columns, rows):
    return scenes()[:, np.clip(columns, 0, 21)[:, None], np.clip(rows, 0, 21)]


HERE = 3 + np.arange(CELLS)


@pytest.mark.parametrize(("right", "down"), [(0, 0), (3, 0), (-2, 1), (1, -2)])
def test_a_camera_that_is_turned_sees_what_is_further_there(right, down):
    noisy = picture(HERE + right, HERE + down)
    noisy ^= np.random.default_rng(1).choice([0, 1, 16, 65], noisy.shape).astype(np.uint8)
    assert camera_of(noisy, picture(HERE, HERE)) == Camera(right, down)


@pytest.mark.parametrize("width", [0.7, 1.3])
def test_another_field_of_view_is_told(width):
    spread = np.rint(10.5 + (np.arange(CELLS) - 7.5) * width).astype(int)
    found = camera_of(picture(spread, spread), picture(HERE, HERE))
    assert found.other_view and "with another field of view" in str(found)


def test_few_answers_tell_nothing():
    assert camera_of(picture(HERE, HERE)[:9], picture(HERE, HERE)[:9]) is None


def test_where_no_move_is_better_than_others_nothing_is_told():
    """Cells that are all alike, and pictures of different places."""
    alike, others = np.zeros((2, PAIRS, CELLS, CELLS, 4), np.uint8)
    assert camera_of(alike, others) is None
    one, other = np.random.default_rng(2).integers(0, 256, (2, *alike.shape), np.uint8)
    assert camera_of(one, other) is None


def test_words_name_directions():
    assert str(Camera()) == "alike"
    words = "turned 2 of 16 columns to the left and 1 of 16 rows down, with another field of view"
    assert str(Camera(-2, 1, True)) == words
