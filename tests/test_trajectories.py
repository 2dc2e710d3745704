"""Poses in the forms of others: KITTI, TUM and GPX, and poses between their points."""

import math
from importlib.util import find_spec

import numpy as np
import pytest
from helpers import refuses
from layout_copies import plant, write

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.poses import UNKNOWN, Pose
from ssrvlad_torch.datasets.trajectories import Trajectory, read_trajectory

needs_gps = pytest.mark.skipif(find_spec("utm") is None, reason="needs the extra gps")


def poses(files):
    return np.array([file.pose for file in files])


def test_kitti_goes_by_the_place_of_a_frame(tmp_path):
    """The camera of KITTI looks along z and has x to its right; the second frame looks right."""
    rows = ["1 0 0 0 0 1 0 0 0 0 1 0", "0 0 1 2 0 1 0 -1.5 -1 0 0 7"]
    kitti = str(write(tmp_path / "00.txt", rows))
    folder = plant(tmp_path / "image_2", "000000.jpg", "000001.jpg")
    files = find_image_files([folder], poses=kitti)
    np.testing.assert_allclose(poses(files), [[0, 0, math.pi / 2], [2, 7, 0]], atol=1e-12)
    only = find_image_files([folder], start=1, poses=kitti)
    assert only[0].pose.y == 7, "places count before frames are left out"
    plant(tmp_path / "image_2", "000002.jpg")
    one_each = r"00\.txt: expected 2 frames, one per pose, got 3"
    refuses(one_each, find_image_files, [folder], poses=kitti)
    other = plant(tmp_path / "image_3", "000000.jpg")
    refuses("poses of one sequence, got 2", find_image_files, [folder, other], poses=kitti)


TURNED = math.sqrt(0.5)
TRUTH = (
    "# timestamp tx ty tz qx qy qz qw\n"
    f"10.00 1 2 9 {-TURNED} 0 0 {TURNED}\n10.10 3 4 9 0 {TURNED} 0 {TURNED}"
)


def poses_by_time(folder, text, names):
    pictures = plant(folder / "pictures", *(f"{name}.jpg" for name in names))
    return poses(find_image_files([pictures], poses=str(write(folder / "tum.txt", text))))


@pytest.mark.parametrize(
    "names",
    [["10.015", "10.050", "10.095"]]
    + [[f"{time:0<{digits}}" for time in (10015, 10050, 10095)] for digits in (5, 8, 11)],
    ids=["s", "ms", "us", "ns"],
)
def test_tum_goes_by_the_time_that_is_a_name(tmp_path, names):
    expected = [[1, 2, math.pi / 2], UNKNOWN, [3, 4, 0]]
    np.testing.assert_allclose(poses_by_time(tmp_path, TRUTH, names), expected, atol=1e-12)


NANOSECONDS = "1403636579758555392", "1403636579858555392"
EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y []\n"
BODY = (
    f"{NANOSECONDS[0]},1,2,9,{TURNED},{-TURNED},0,0",
    f"{NANOSECONDS[1]},3,4,9,{TURNED},0,{TURNED},0",
)
FORMS = {
    "EuRoC": ("data.csv", EUROC + "".join(f"{row}{',0.1' * 9}\n" for row in BODY), NANOSECONDS),
    "TUM-VI": ("data.csv", EUROC + "\n".join(BODY), NANOSECONDS),
    "TUM": (
        "tum.txt",
        TRUTH.replace("# ", "") + "\n10.15 nan nan nan 0 0 0 1",
        ("10.00", "10.10", "10.15"),
    ),
    "COLMAP": (
        "images.txt",
        f"# x\n1 {TURNED} {TURNED} 0 0 -1 9 -2 1 pictures/0.png\n10 20 -1\n"
        "2 0.5 0.5 -0.5 0.5 4 9 -3 1 a b.jpg\n\n",
        ("0", "a b"),
    ),
    "KITTI-360": (
        "poses.txt",
        "0 0 1 0 1 1 0 0 2 0 0 -1 9\n1 1 0 0 3 0 -1 0 4 0 0 -1 9",
        ("0000000000", "0000000001", "0000000007"),
    ),
    "cameras of KITTI-360": (
        "cam0_to_world.txt",
        "0 1 0 0 1 0 0 1 2 0 -1 0 9 0 0 0 1\n1 0 0 1 3 -1 0 0 4 0 -1 0 9 0 0 0 1",
        ("0000000000", "0000000001"),
    ),
}


@pytest.mark.parametrize(("name", "text", "frames"), FORMS.values(), ids=FORMS)
def test_files_of_data_sets_are_read_and_what_they_lack_is_unknown(tmp_path, name, text, frames):
    pictures = plant(tmp_path / "pictures", *(f"{frame}.jpg" for frame in frames))
    files = find_image_files([pictures], poses=str(write(tmp_path / name, text)))
    expected = [[1, 2, math.pi / 2], [3, 4, 0], *[UNKNOWN] * (len(frames) - 2)]
    np.testing.assert_allclose(poses(files), expected, atol=1e-9)


@needs_gps
def test_robotcar_says_when_it_does_not_know_where_it_is(tmp_path):
    text = "timestamp,ins_status,latitude,longitude,yaw\n" + "".join(
        f"14188411{n}5000000,INS_{status},52.2,0.12,0.5\n"
        for n, status in enumerate(("SOLUTION_GOOD", "BAD_GPS_AGREEMENT", "SOLUTION_GOOD"))
    )
    trajectory = read_trajectory(write(tmp_path / "ins.csv", text))
    assert trajectory.stamps == [1418841105, 1418841125]
    np.testing.assert_allclose(
        trajectory.of_frames(["1418841105000000"])[0],
        [303189.31, 5787193.03, math.pi / 2 - 0.5],
        atol=0.01,
    )


@pytest.mark.parametrize(
    ("text", "names", "message"),
    [
        (TRUTH, ["99.1"], r"tum.txt: no pose is near.* '99.1'; expected"),
        (TRUTH, ["a", "10.015"], r"named by their time in seconds.* 'a'"),
    ],
)
def test_names_that_are_no_time_of_the_file_are_refused(tmp_path, text, names, message):
    refuses(message, poses_by_time, tmp_path, text, names)


def test_numbers_of_frames_are_no_milliseconds(tmp_path):
    name, text, _ = FORMS["KITTI-360"]
    trajectory = read_trajectory(write(tmp_path / name, text))
    refuses("'0000001000'; expected numbers between 0 and 1", trajectory.of_frames, ["0000001000"])
    refuses("expected frames named by their numbers.*'a1'", trajectory.of_frames, ["a1"])


def test_times_of_euroc_may_be_as_short_as_numbers_of_frames(tmp_path):
    rows = (f"{time},{x},2,9,{TURNED},{-TURNED},0,0{',0.1' * 9}\n" for time, x in ((0, 1), (5, 3)))
    trajectory = read_trajectory(write(tmp_path / "data.csv", EUROC + "".join(rows)))
    np.testing.assert_allclose([pose.x for pose in trajectory.poses], [1, 3])
    assert trajectory.stamps == [0, 5e-9] and not trajectory.by_number


def test_lines_of_two_forms_are_refused(tmp_path):
    _, car, _ = FORMS["KITTI-360"]
    camera = FORMS["cameras of KITTI-360"][1].splitlines()[1]
    mixed = write(tmp_path / "poses.txt", car.splitlines()[0] + "\n" + camera)
    refuses("expected lines of one form", read_trajectory, mixed)


def test_poses_are_interpolated_by_time_and_the_shorter_turn():
    """The heading turns by the shorter way, and is unknown if one of the two is."""
    poses = [Pose(0, 0, 3), Pose(10, 20, -3), Pose(20, 20, math.nan), Pose(50, 20, 0)]
    trajectory = Trajectory(poses, [100, 102, 103, 110], 2)
    quarter, exact, after, gap, before = trajectory.of_frames(
        list("abcde"), [100.5, 102, 102.5, 105, 99.9]
    )
    assert quarter == pytest.approx((2.5, 5, 3 + (math.tau - 6) / 4))
    assert exact == poses[1]
    assert after[:2] == (15, 20) and math.isnan(after.heading)
    assert math.isnan(gap.x) and math.isnan(before.x)
    assert trajectory.timed(["100.5"]) == ([100.5], [quarter])


START = 764_426_119
"""1994-03-23 12:35:19 UTC."""


def gpx(*points, head=""):
    return f'{head}<gpx version="1.1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'


POINT = '<trkpt lat="48.1173" lon="11.5"><time>1994-03-23T{time}</time></trkpt>'


@needs_gps
def test_gpx_points_give_times_and_positions(tmp_path):
    points = POINT.format(time="12:35:19Z"), POINT.format(time="14:35:20.25+02:00")
    track = read_trajectory(write(tmp_path / "a.gpx", gpx(*points)))
    assert track.stamps == [START, START + 1.25]
    assert all(math.isnan(pose.heading) for pose in track.poses)


NOON = POINT.format(time="12:35:19Z")
DAMAGED = [
    ("txt", "1 2 3", r"line 1: expected 12 numbers \(KITTI\), .* or 8 \(TUM\), got 3"),
    ("txt", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "in order of time"),
    ("txt", "1 0 0 0 0 0 0 0", "line 1: .* is not a rotation"),
    ("txt", "1 0 0 inf 0 0 0 1", "line 1: expected a finite number, got inf"),
    ("txt", "# nothing", "holds no poses"),
    ("txt", "$GNRMC,123519.00,A,4807.038,N", "sentences of NMEA; convert them to GPX"),
    ("csv", "timestamp,latitude,longitude\n5,a,2\n", "line 2: could not convert"),
    ("gpx", gpx(), "holds no positions; expected track points"),
    ("gpx", gpx('<trkpt lat="48" lon="11"/>'), "point 1 has no time"),
    ("gpx", gpx(NOON, POINT.format(time="12:35:18Z")), "position 2 is earlier than the one before"),
    ("gpx", gpx(head='<!DOCTYPE gpx [<!ENTITY a "aaa">]>'), "without a document type"),
    ("gpx", gpx(NOON.replace("48", "88")), "latitude 88.1173 out of range"),
    ("gpx", gpx(NOON.replace("48", "4_8")), "could not convert"),
]


@pytest.mark.parametrize(("suffix", "content", "message"), DAMAGED)
def test_a_damaged_file_is_refused_by_name(tmp_path, suffix, content, message):
    if suffix != "txt":
        pytest.importorskip("utm", reason="needs the extra gps")
    path = write(tmp_path / f"a.{suffix}", content)
    refuses(f"(?i)^{path}.*{message}", read_trajectory, path)


@needs_gps
def test_nothing_lies_between_two_segments_of_gpx(tmp_path):
    """The receiver was off: between these 11 km it was at no place that could be guessed."""
    path = tmp_path / "a.gpx"
    there, later = (POINT.format(time=f"12:35:{second}Z") for second in (19, 20))
    away, further = (
        POINT.format(time=f"12:35:{second}Z").replace("48.1", "48.2") for second in (24, 25)
    )
    border = "</trkseg><trkseg/><trkseg>"
    for text in (border, "</trkseg></trk><trk><trkseg>"):
        path.write_text(gpx(there, later, text, away, further))
        trajectory = read_trajectory(path)
        placed = trajectory.of_frames(list("abcde"), [START + s for s in (0.5, 1, 3, 5, 5.5)])
        assert [math.isnan(pose.x) for pose in placed] == [False, False, True, False, False]
        assert placed[4].y - placed[0].y == pytest.approx(11_120, abs=20)
    path.write_text(gpx(there, later, away, further))
    (bridged,) = read_trajectory(path).of_frames(["a"], [START + 3])
    assert not math.isnan(bridged.x)
