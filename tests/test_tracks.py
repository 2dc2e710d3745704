"""GPX and NMEA files, and poses between their points."""

import math

import pytest
from helpers import refused

from ssrvlad_torch.datasets.poses import Pose
from ssrvlad_torch.datasets.tracks import read_track
from ssrvlad_torch.datasets.trajectories import Trajectory, read_trajectory

pytest.importorskip("utm", reason="needs the extra gps")

START = 764_426_119
"""1994-03-23 12:35:19 UTC, of the usual example of NMEA."""

RMC = "GPRMC,{time},A,4807.038,N,01131.000,E,022.4,{course},230394,003.1,W"


def sentence(body):
    total = 0
    for character in body:
        total ^= ord(character)
    return f"${body}*{total:02X}\n"


def gpx(*points, head=""):
    return f'{head}<gpx version="1.1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'


POINT = '<trkpt lat="48.1173" lon="11.5"><time>1994-03-23T{time}</time></trkpt>'


def test_nmea_sentences_give_times_positions_and_courses(tmp_path):
    path = tmp_path / "a.nmea"
    path.write_text(
        sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,")
        + sentence(RMC.format(time="123519.50", course="084.4"))
        + sentence("GPRMC,123520,V,,,,,,,230394,,")
        + sentence(RMC.format(time="123521", course=""))
    )
    (((first, fix), (second, other)),) = read_track(path)
    assert (first, second) == (START + 0.5, START + 2)
    assert fix == pytest.approx((48 + 7.038 / 60, 11 + 31 / 60, 84.4))
    assert math.isnan(other.course)
    trajectory = read_trajectory(path)
    assert trajectory.poses[0].heading == pytest.approx(math.radians(5.6))
    assert trajectory.largest_gap == 5


def test_gpx_points_give_times_and_positions(tmp_path):
    path = tmp_path / "a.gpx"
    path.write_text(gpx(POINT.format(time="12:35:19Z"), POINT.format(time="14:35:20.25+02:00")))
    (segment,) = read_track(path)
    assert [time for time, _ in segment] == [START, START + 1.25]
    assert all(math.isnan(pose.heading) for pose in read_trajectory(path).poses)


NOON = POINT.format(time="12:35:19Z")
NMEA = RMC.format(time="123519", course="1")
DAMAGED = [
    ("gpx", gpx(), "holds no positions; expected track points"),
    ("gpx", gpx('<trkpt lat="48" lon="11"/>'), "point 1 has no time"),
    ("gpx", gpx(NOON, POINT.format(time="12:35:18Z")), "position 2 is earlier than the one before"),
    ("gpx", gpx(head='<!DOCTYPE gpx [<!ENTITY a "aaa">]>'), "without a document type"),
    ("gpx", gpx(NOON)[:-9], "Error parsing XML"),
    ("gpx", gpx(NOON.replace("48", "88")), "latitude out of range"),
    ("nmea", "", "holds no positions; expected RMC sentences"),
    ("nmea", sentence(NMEA).replace("48", "49"), "line 1: .*checksum"),
    ("nmea", sentence(NMEA.replace("N", "")), "line 1: expected a position, got 4807.038,,01131.0"),
    ("gpx", gpx(POINT.format(time="12:35:60Z")), "point 1 has no time, as 2026-"),
    ("nmea", sentence(NMEA.replace("4807.038", "4875.038")), "at most 60 minutes, got 4875.038,N,"),
    (
        "nmea",
        sentence(NMEA.replace(",E,", ",O,")),
        "expected a position, got 4807.038,N,01131.000,O",
    ),
    ("nmea", sentence(NMEA.replace("123519", "235960")), "expected a time of day, got 235960"),
    ("nmea", sentence("GPRMC,x,A,y,N,z,E,022.4,1,230394,,"), "line 1: "),
]


@pytest.mark.parametrize(("suffix", "content", "message"), DAMAGED)
def test_damaged_files_are_refused(tmp_path, suffix, content, message):
    path = tmp_path / f"a.{suffix}"
    path.write_text(content)
    with refused(f"(?i)^{path}.*{message}"):
        read_trajectory(path)


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
        trajectory = read_trajectory(path, largest_gap=math.inf)
        known = trajectory.of_frames(list("abcde"), [START + s for s in (0.5, 1, 3, 5, 5.5)])
        assert [math.isnan(pose.x) for pose in known] == [False, False, True, False, False]
        assert known[4].y - known[0].y == pytest.approx(11_120, abs=20)
    path.write_text(gpx(there, later, away, further))
    (bridged,) = read_trajectory(path).of_frames(["a"], [START + 3])
    assert not math.isnan(bridged.x)


@pytest.mark.parametrize("gap", [math.nan, -1, -0.001])
def test_a_negative_or_nan_gap_is_refused(tmp_path, gap):
    """NaN would bridge every gap."""
    path = tmp_path / "a.gpx"
    path.write_text(gpx(NOON))
    with refused(rf"largest gap of 0 seconds or more, got {gap}"):
        read_trajectory(path, largest_gap=gap)
    with refused("largest gap of 0 seconds or more"):
        Trajectory([Pose(0, 0, 0)], [0.0], gap)
