"""The picture of the loops: what is drawn, with poses and without."""

import numpy as np
import pytest
from PIL import Image

from ssrvlad_torch.loops.picture import draw_loops

POSES = np.array([(0, 0, 0), (10, 0, 0), (20, 5, 1), (10, 5, 3), (0, 1, 3), (10, 1, 0.1)], float)
LOOPS = np.array([-1, -1, -1, -1, 0, 2])


def picture(path, *arguments, **more):
    draw_loops(path, *arguments, **more)
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def shows(pixels, red, green, blue):
    """Whether a colour occurs, antialiased at most a little."""
    return bool((np.abs(pixels - (red, green, blue)).sum(axis=-1) < 30).any())


GREEN, RED, BLUE = (44, 160, 44), (214, 39, 40), (31, 119, 180)


def test_right_loops_are_green_and_wrong_ones_red(tmp_path):
    both = picture(tmp_path / "a.png", LOOPS, POSES, "drive", metres=5)
    assert [shows(both, *colour) for colour in (GREEN, RED, BLUE)] == [True, True, False]
    right = picture(tmp_path / "b.png", LOOPS, POSES, "drive", metres=50)
    assert [shows(right, *colour) for colour in (GREEN, RED)] == [True, False]
    unjudged = picture(tmp_path / "c.png", LOOPS, POSES, "drive")
    assert [shows(unjudged, *colour) for colour in (GREEN, RED, BLUE)] == [False, False, True]


def test_without_poses_there_is_no_trajectory(tmp_path):
    placed = picture(tmp_path / "a.png", LOOPS, POSES, "drive")
    bare = picture(tmp_path / "b.png", LOOPS, np.full((6, 3), np.nan), "drive")
    assert bare.shape[1] * 2 == placed.shape[1]
    assert shows(bare, *BLUE)


def test_some_poses_may_be_unknown(tmp_path):
    poses = POSES.copy()
    poses[[0, 3]] = np.nan
    assert shows(picture(tmp_path / "a.png", LOOPS, poses, "drive", metres=50), *RED)


@pytest.mark.parametrize("frames", [0, 3])
def test_a_stream_without_loops_is_drawn(tmp_path, frames):
    pixels = picture(tmp_path / "a.png", np.full(frames, -1), POSES[:frames], "drive")
    assert not shows(pixels, *BLUE)


def test_the_suffix_says_the_format(tmp_path):
    draw_loops(tmp_path / "loops.svg", LOOPS, POSES, "drive")
    assert "<svg" in (tmp_path / "loops.svg").read_text()
    with pytest.raises(ValueError, match=r"loops\.xyz: a picture is one of .*png"):
        draw_loops(tmp_path / "loops.xyz", LOOPS, POSES, "drive")
    assert [path.name for path in tmp_path.iterdir()] == ["loops.svg"]
