"""`export/pose_graph.py`: from loops to a corrected drive."""

import json
import math
import sys
from functools import partial

import numpy as np
import pose_graph
import pytest
from helpers import outcome, refuses
from PIL import Image
from pose_graph import Loop, correct, in_front, moved, read_loops, read_odometry, tum_line

from ssrvlad_torch.datasets.pose_tables import read_poses, write_poses
from ssrvlad_torch.datasets.poses import Pose
from ssrvlad_torch.datasets.trajectories import read_trajectory

SIDE, LAPS = 25, 3


def laps(turn_error=0.0):
    """Rounds of a square of 50 m, a pose every 2 m; the odometry turns too much at each corner."""
    poses = [np.zeros(3)]
    for number in range(4 * SIDE * LAPS):
        corner = (math.pi / 2 + turn_error) * (number % SIDE == SIDE - 1)
        poses.append(moved(poses[-1], np.array([2.0, 0.0, corner])))
    return np.stack(poses)


def loops_of(poses, ahead=0.0):
    """Every frame after the first round is where it was a round ago."""
    return [Loop(row, row - 4 * SIDE, ahead) for row in range(4 * SIDE, len(poses))]


def error(poses, truth):
    return float(np.sqrt(np.square(poses - truth)[:, :2].sum(1).mean()))


def test_loops_take_the_drift_out_of_a_drive():
    truth, odometry = laps(), laps(turn_error=0.02)
    after = correct(odometry, loops_of(truth))
    assert error(odometry, truth) > 3
    assert error(after.poses, truth) < 0.3 * error(odometry, truth)
    assert after.believed.min() > 0.9


@pytest.mark.parametrize("run", [1, 10])
def test_one_wrong_loop_in_twenty_changes_nothing(run):
    """Alone, and as runs of neighbouring frames that agree with each other."""
    truth, odometry = laps(), laps(turn_error=0.02)
    loops, rng = loops_of(truth), np.random.default_rng(0)
    wrong = []
    while len(wrong) < len(loops) / 20:
        frame, there = rng.integers(150, 290), rng.integers(0, 80)
        if np.hypot(*(truth[frame] - truth[there])[:2]) > 20:
            wrong += [Loop(int(frame) + n, int(there) + n) for n in range(run)]
    alone, after = correct(odometry, loops), correct(odometry, loops + wrong)
    assert after.believed[len(loops) :].max() < 0.01
    assert after.poses == pytest.approx(alone.poses, abs=0.05)


def test_ahead_is_along_the_drive_also_around_a_corner():
    poses = laps()
    corner = in_front(poses, SIDE - 2, 8.0)
    assert corner == pytest.approx([50, 4, math.pi / 2])
    assert in_front(poses, SIDE - 2, -3.0) == pytest.approx([43, 0, 0])
    assert in_front(poses, 0, -3.0) == pytest.approx([-3, 0, 0])
    assert in_front(poses, 0, 3.0) == pytest.approx([3, 0, 0])


def test_a_frame_ahead_of_its_candidate_stays_ahead():
    odometry = np.array([[x, 0.0, 0.0] for x in range(0, 50, 2)])
    again = np.concatenate((odometry, odometry + np.array([1.0, 0, 0])))
    drives = [slice(0, 25), slice(25, 50)]
    loops = [Loop(25 + row, row, 1.0) for row in range(25)]
    shifted = np.concatenate((odometry, moved(np.array([99.0, 7.0, 2.0]), odometry)))
    after = correct(shifted, loops, drives=drives).poses
    assert after == pytest.approx(again, abs=1e-3)


def test_a_second_drive_without_a_loop_into_the_first_is_refused():
    with pytest.raises(ValueError, match="frames 25 to 49 have no loop"):
        correct(np.zeros((50, 3)), [Loop(20, 3)], drives=[slice(0, 25), slice(25, 50)])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (['{"frame": "a/1"}'], "line 1: expected JSON"),
        (["nothing"], "line 1: expected JSON"),
        ([{"frame": "a/1", "reason": "no_candidate"}] * 2, "line 2: frame 'a/1' was there before"),
        (
            [{"frame": "a/1", "reason": "accepted", "candidate": "b/1", "ahead": None}],
            "line 1: candidate 'b/1' has no line",
        ),
    ],
)
def test_lines_of_another_form_are_refused(lines, message):
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    refuses(message, read_loops, texts)


@pytest.fixture
def drive(tmp_path):
    """Lines of `ssrvlad loops --json`, and odometry, of rounds of a square."""
    odometry = laps(turn_error=0.02)
    frames = [f"drive/{row:06d}" for row in range(len(odometry))]
    lines = []
    for row, frame in enumerate(frames):
        there = f"drive/{row - 4 * SIDE:06d}" if row >= 4 * SIDE else None
        reason = "accepted" if there else "no_candidate"
        lines.append({"frame": frame, "reason": reason, "candidate": there, "ahead": 0.0})
    lines.append({"frames": len(frames), "precision": 1.0})
    (tmp_path / "loops.jsonl").write_text("\n".join(map(json.dumps, lines)))
    poses = [Pose(*pose) for pose in odometry.tolist()]
    write_poses(tmp_path / "poses.csv", dict(zip(frames, poses, strict=True)))
    stamped = [tum_line(float(row), pose) for row, pose in enumerate(poses)]
    (tmp_path / "odometry.tum").write_text("".join(stamped))
    return tmp_path


@pytest.fixture
def run(main_of):
    return partial(main_of, pose_graph.main, "pose_graph.py")


def test_the_program_is_a_process_of_its_own(drive):
    words = (drive / "loops.jsonl", "--odometry", drive / "poses.csv", "-o", drive / "corrected")
    code, lines, errors = outcome(sys.executable, pose_graph.__file__, *words)
    assert (code, errors) == (0, [])
    assert lines == [f"301 poses, 201 loops, 0 refused: {drive / 'corrected'}"]


@pytest.mark.parametrize("odometry", ["poses.csv", "odometry.tum"])
def test_the_program_writes_the_corrected_drive(run, drive, odometry):
    out = drive / "corrected"
    code, said, errors = run(drive / "loops.jsonl", "--odometry", drive / odometry, "-o", out)
    assert code == 0, errors
    assert said == f"301 poses, 201 loops, 0 refused: {out}\n"
    corrected = np.array(list(read_poses(out / "poses.csv").values()))
    assert error(corrected, laps()) < 0.3 * error(laps(turn_error=0.02), laps())
    tum = read_trajectory(out / "poses.tum")
    assert np.array(tum.poses)[:, :2] == pytest.approx(corrected[:, :2], abs=1e-5)
    assert tum.stamps == [float(row) for row in range(301)]
    words = [line.split()[0] for line in (out / "graph.g2o").read_text().splitlines()]
    assert words.count("VERTEX_SE2") == 301
    assert words.count("EDGE_SE2") == 300 + 201
    assert Image.open(out / "drive.png").size > (400, 200)


def test_frames_at_a_standstill_have_their_own_stamps(tmp_path):
    (tmp_path / "still.tum").write_text("".join(tum_line(t, Pose(1, 2, 0)) for t in range(4)))
    poses, stamps = read_odometry(tmp_path / "still.tum", [f"drive/{t}.01" for t in range(4)])
    assert list(stamps) == [0.01, 1.01, 2.01, 3.01]
    np.testing.assert_allclose(poses, [[1, 2, 0]] * 4, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--odometry", "missing.csv"], "missing.csv"),
        (["--odometry", "loops.jsonl"], "loops.jsonl line 2"),
        (["--odometry", "poses.csv", "--drift", "0"], "above 0"),
    ],
)
def test_wrong_arguments_are_one_line(run, drive, arguments, message):
    given = [drive / a if "." in a and not a.startswith("-") else a for a in arguments]
    code, _, errors = run(drive / "loops.jsonl", *given, "-o", drive / "out")
    assert code == 2
    assert message in errors[-1]
    assert not (drive / "out").exists()
