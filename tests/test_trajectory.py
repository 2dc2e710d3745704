"""The picture of the loops: what is drawn, with poses and without."""

import numpy as np
import pytest

from ssrvlad_torch.files import write_picture
from ssrvlad_torch.loops.picture import draw_loops

POSES = np.array([(0, 0, 0), (10, 0, 0), (20, 5, 1), (10, 5, 3), (0, 1, 3), (10, 1, 0.1)], float)
LOOPS = np.array([-1, -1, -1, -1, 0, 2])


def dots(axes):
    """Places of the dots by their colours."""
    found = [line for line in axes.lines if line.get_marker() == "." and len(line.get_xdata())]
    return {line.get_color(): line.get_xydata().tolist() for line in found}


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_right_loops_are_green_and_wrong_ones_red():
    above, beside = draw_loops(LOOPS, POSES, "drive", metres=5).axes
    assert dots(above) == {"tab:green": [[0, 1]], "tab:red": [[10, 1]]}
    assert dots(beside) == {"tab:green": [[4, 0]], "tab:red": [[5, 2]]}
    assert {"right, within 5 m: 1", "wrong, or of unknown pose: 1"} <= {*legend(beside)}
    above, beside = draw_loops(LOOPS, POSES, "drive", metres=50).axes
    assert dots(above) == {"tab:green": [[0, 1], [10, 1]]}
    unjudged = draw_loops(LOOPS, POSES, "drive").axes[1]
    assert dots(unjudged) == {"tab:blue": [[4, 0], [5, 2]]} and "loops: 2" in legend(unjudged)


def test_without_poses_there_is_no_trajectory():
    (beside,) = draw_loops(LOOPS, np.full((6, 3), np.nan), "drive").axes
    assert dots(beside) == {"tab:blue": [[4, 0], [5, 2]]}


@pytest.mark.parametrize("frames", [0, 3])
def test_a_stream_without_loops_is_drawn(frames, tmp_path):
    figure = draw_loops(np.full(frames, -1), POSES[:frames], "a folder named $_{$")
    assert "loops: 0" in legend(figure.axes[-1])
    write_picture(figure, tmp_path / "loops.png")


def test_the_suffix_says_the_format(tmp_path):
    figure = draw_loops(LOOPS, POSES, "drive")
    write_picture(figure, tmp_path / "loops.svg")
    assert "<svg" in (tmp_path / "loops.svg").read_text()
    with pytest.raises(ValueError, match=r"loops\.xyz: a picture is one of .*png"):
        write_picture(figure, tmp_path / "loops.xyz")
    assert [path.name for path in tmp_path.iterdir()] == ["loops.svg"]
