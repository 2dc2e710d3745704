"""Poses of one sequence in files of KITTI, TUM and GPX, and the poses of its frames."""

import csv
import io
import math
import re
from bisect import bisect_left
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC
from itertools import pairwise
from pathlib import Path

from ..files import naming, read_text, requiring
from .camera_poses import Y_DOWN, Z_UP, optical_axis, words_of
from .poses import UNKNOWN, Fix, Pose, Projection, parse_number

_KITTI, _TUM, _EUROC = 12, 8, 17
"""Numbers in a line."""
_SURE = "INS_SOLUTION_GOOD"
"""Of RobotCar: the receiver knows where it is."""
_NEAREST_SECONDS = 0.02
"""Largest distance to the nearest pose of TUM, as in TUM's own tools."""
_GAP_SECONDS = 5.0
"""Between two positions of a GPS receiver, up to which positions are interpolated; a receiver gives
one a second."""
_UNITS = (1, 1e-3, 1e-6, 1e-9)
"""Seconds, milliseconds, microseconds and nanoseconds."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of one sequence, in order.

    Attributes:
        stamps: time of each pose in seconds, increasing; empty if the n-th is of the n-th frame.
        gap: between two poses at most this many seconds apart a frame's pose is interpolated;
            elsewhere it is unknown. ``None``: the nearest pose is used up to 0.02 s away.
        starts: places of poses before which nothing was recorded: none is interpolated there.
    """

    poses: list[Pose]
    stamps: list[float]
    gap: float | None = None
    starts: frozenset[int] = frozenset()

    def of_frames(self, names: Sequence[str], stamps: Sequence[float] = ()) -> list[Pose]:
        """The pose of each frame: the n-th pose, or, if poses have stamps, the pose at its time,
        which is one of ``stamps`` in seconds or its name, in seconds or a whole number of milli-,
        micro- or nanoseconds, whichever reaches most of the trajectory. Other numbers of frames
        than poses, a name that is no time, and no unit that gives poses are a ValueError."""
        if not self.stamps:
            if len(names) != len(self.poses):
                raise ValueError(
                    f"expected {len(self.poses)} frames, one per pose, got {len(names)}"
                )
            return self.poses
        count, poses = max(map(self._reached, _times_of(names, stamps)), key=lambda pair: pair[0])
        if not count:
            raise ValueError(
                f"no pose is near in time to the {len(names)} frames, for example {names[0]!r}; "
                f"expected names in seconds between {self.stamps[0]} and {self.stamps[-1]}, or in "
                "ms, us or ns, or a video or bag of that time"
            )
        return poses

    def _reached(self, times: Sequence[float]) -> tuple[int, list[Pose]]:
        """How much of the trajectory some times reach, and the poses then: in too small a unit all
        frames of a sequence are near its first pose."""
        poses = [self._at(time) for time in times]
        posed = (time for time, pose in zip(times, poses, strict=True) if pose is not UNKNOWN)
        return len({bisect_left(self.stamps, time) for time in posed}), poses

    def _at(self, time: float) -> Pose:
        after = bisect_left(self.stamps, time)  # the first pose that is not before the time
        around = range(max(0, after - 1), min(len(self.stamps), after + 1))
        nearest = min(around, key=lambda n: abs(self.stamps[n] - time))
        if abs(self.stamps[nearest] - time) <= (_NEAREST_SECONDS if self.gap is None else 0):
            return self.poses[nearest]
        seconds = self.stamps[around[-1]] - self.stamps[around[0]]
        if self.gap is None or len(around) == 1 or seconds > self.gap or after in self.starts:
            return UNKNOWN
        before, following = self.poses[after - 1], self.poses[after]
        fraction = (time - self.stamps[after - 1]) / seconds
        turn = math.remainder(following.heading - before.heading, math.tau)
        return Pose(
            before.x + fraction * (following.x - before.x),
            before.y + fraction * (following.y - before.y),
            math.remainder(before.heading + fraction * turn, math.tau),
        )


def _times_of(names: Sequence[str], stamps: Sequence[float]) -> list[Sequence[float]]:
    """What the times of frames can be: their stamps, and their names in each unit."""
    times: list[Sequence[float]] = [stamps] if stamps and not any(map(math.isnan, stamps)) else []
    are_whole = all(name.isdecimal() for name in names)
    if times and not are_whole:
        return times
    with naming("expected frames named by their time in seconds"):
        numbers = [parse_number(name) for name in names]
    units = _UNITS if are_whole else _UNITS[:1]
    return times + [[number * unit for number in numbers] for unit in units]


def read_trajectory(path: Path, projection: Projection | None = None) -> Trajectory:
    """The poses in a GPX file, or in a file of KITTI, TUM, EuRoC or RobotCar, recognised by its
    first line. A file of another form is a ValueError that names the line.

    KITTI: the matrix ``(3, 4)`` from camera to world (x right, y down, z ahead). TUM: ``time x y z
    qx qy qz qw``, z is up. EuRoC: nanoseconds, ``x y z qw qx qy qz``; the body's z is taken for the
    camera's. RobotCar's ``ins.csv`` and ``gps.csv``, and GPX (extra ``gps``): metres of UTM, the
    heading is the yaw or course; nothing is interpolated over more than 5 s, or between segments.
    """
    text, projection = read_text(path), projection or Projection()
    first = text.lstrip().partition("\n")[0]
    if path.suffix.lower() == ".gpx":
        with requiring("gps", f"{path} needs"), naming(path):
            return _parse_gpx(text, projection)
    if {"timestamp", "latitude", "longitude"} <= {*first.strip().split(",")}:
        return _parse_robotcar(path, text, projection)
    if first.startswith("$G"):
        raise ValueError(f"{path} holds sentences of NMEA; convert them to GPX (gpsbabel)")
    poses, stamps, is_first = list[Pose](), list[float](), True
    for place, words in words_of(path, text.replace(",", " ")):
        is_header, is_first = is_first and _is_header(words), False
        if is_header:
            continue
        with naming(place):
            numbers = [parse_number(word) for word in words]
            if len(numbers) == _KITTI:
                poses.append(Y_DOWN.pose(numbers[3::4], numbers[2::4]))
                continue
            if len(numbers) == _EUROC or (len(numbers) == _TUM and "q_RS_w" in first):
                time, x, y, z, real, i, j, k = numbers[:_TUM]
                time *= 1e-9
            elif len(numbers) == _TUM:
                time, x, y, z, i, j, k, real = numbers
            else:
                raise ValueError(f"expected 12 numbers (KITTI) or 8 (TUM), got {len(numbers)}")
            if any(map(math.isnan, numbers[1:_TUM])):
                continue
            # the file holds camera to world, `optical_axis` expects the inverse
            poses.append(Z_UP.pose((x, y, z), optical_axis((real, -i, -j, -k))))
            stamps.append(time)
    in_order = all(before <= after for before, after in pairwise([*stamps, math.inf]))
    if stamps and (len(stamps) != len(poses) or not in_order):
        raise ValueError(f"{path}: expected lines of 8 numbers in order of time")
    if not poses:
        raise ValueError(f"{path} holds no poses")
    return Trajectory(poses, stamps)


def _is_header(words: Sequence[str]) -> bool:
    """Whether a line names columns: no word of it is a number."""
    for word in words:
        with suppress(ValueError):
            parse_number(word)
            return False
    return True


def _parse_robotcar(path: Path, text: str, projection: Projection) -> Trajectory:
    """Microseconds, degrees, and a yaw in radians clockwise from north."""
    fixes, stamps = list[Fix](), list[float]()
    for number, row in enumerate(csv.DictReader(io.StringIO(text)), 2):
        if (row.get("ins_status") or _SURE) != _SURE:
            continue
        with naming(f"{path} line {number}"):
            columns = [row[name] or "" for name in ("timestamp", "latitude", "longitude")]
            time, latitude, longitude = map(parse_number, columns)
            course = math.degrees(parse_number(row.get("yaw") or "nan"))
            fix = Fix(latitude, longitude, course)
            if fix.is_known:
                fixes.append(fix)
                stamps.append(time * 1e-6)
    if not fixes or stamps != sorted(stamps):
        raise ValueError(f"{path}: expected positions in order of time")
    return Trajectory(projection.poses(fixes), stamps, _GAP_SECONDS)


def _parse_gpx(text: str, projection: Projection) -> Trajectory:
    import gpxpy

    if "<!" in text.replace("<!--", "").replace("<![CDATA[", ""):
        raise ValueError("expected GPX without a document type")  # its entities can grow
    for point in re.findall(r"<(?:\w+:)?trkpt\b[^<>]*", text):
        for number in re.findall(r"""\s(?:lat|lon)\s*=\s*["']([^"']*)""", point):
            parse_number(number)  # gpxpy reads also 1_0 and digits of other scripts
    fixes, stamps, starts = list[Fix](), list[float](), set[int]()
    for track in gpxpy.parse(text).tracks:
        for segment in track.segments:
            starts.add(len(fixes))
            for point in segment.points:
                if point.time is None:
                    number = len(fixes) + 1
                    raise ValueError(f"point {number} has no time, as 2026-05-01T10:00:00Z")
                time = point.time if point.time.tzinfo else point.time.replace(tzinfo=UTC)
                stamps.append(time.timestamp())
                if stamps[-1] < stamps[len(fixes) - 1]:
                    raise ValueError(f"position {len(stamps)} is earlier than the one before it")
                course = math.nan if point.course is None else float(point.course)
                fixes.append(Fix(point.latitude, point.longitude, course))
    if not fixes:
        raise ValueError("holds no positions; expected track points")
    return Trajectory(projection.poses(fixes), stamps, _GAP_SECONDS, frozenset(starts))
