"""Files of poses: tables by frame, and those of one sequence by time or number."""

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
from operator import itemgetter
from pathlib import Path, PurePosixPath
from unicodedata import normalize

from ..files import naming, read_text, requiring
from .camera_poses import Y_DOWN, Z_UP, optical_axis, words_of
from .names import IMAGE_SUFFIXES
from .poses import UNKNOWN, Fix, Pose, Projection, parse_number

_KITTI, _TUM, _EUROC, _KITTI_360 = 12, 8, 17, (13, 17)
"""Numbers in a line; of KITTI-360 of the car and of a camera."""
_FRAME_DIGITS = 10
"""Of the number of a frame; a time in nanoseconds has more."""
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
        by_number: whether stamps are the numbers of frames, which their names have.
    """

    poses: list[Pose]
    stamps: list[float]
    gap: float | None = None
    starts: frozenset[int] = frozenset()
    by_number: bool = False

    def of_frames(self, names: Sequence[str], stamps: Sequence[float] = ()) -> list[Pose]:
        """The pose of each frame; see `timed`."""
        return self.timed(names, stamps)[1]

    def timed(
        self, names: Sequence[str], stamps: Sequence[float] = ()
    ) -> tuple[Sequence[float], list[Pose]]:
        """The times and the poses of frames: the n-th has time n and the n-th pose, or, if poses
        have stamps, the pose at its time, which is one of ``stamps`` in seconds or its name, in
        seconds or a whole number of milli-, micro- or nanoseconds, whichever reaches most of the
        trajectory. Other numbers of frames than poses, a name that is no time, and no unit that
        gives poses are a ValueError."""
        if not self.stamps:
            if len(names) != len(self.poses):
                raise ValueError(
                    f"expected {len(self.poses)} frames, one per pose, got {len(names)}"
                )
            return range(len(names)), self.poses
        if self.by_number:
            with naming("expected frames named by their numbers"):
                numbers = [parse_number(name) for name in names]
            count, poses = self._reached(numbers)
            if not count:
                raise ValueError(
                    f"no pose is of one of the {len(names)} frames, for example {names[0]!r}; "
                    f"expected numbers between {self.stamps[0]:.0f} and {self.stamps[-1]:.0f}"
                )
            return numbers, poses
        possible = [(*self._reached(times), times) for times in _times_of(names, stamps)]
        count, poses, times = max(possible, key=itemgetter(0))
        if not count:
            raise ValueError(
                f"no pose is near in time to the {len(names)} frames, for example {names[0]!r}; "
                f"expected names in seconds between {self.stamps[0]} and {self.stamps[-1]}, or in "
                "ms, us or ns, or a video or bag of that time"
            )
        return times, poses

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


def read_poses(
    path: Path, projection: Projection | None = None, by_time: bool = False
) -> dict[str, Pose]:
    """Poses by frame, an id or a name, in Unicode's form NFC, without the suffix of a picture.
    Columns are ``frame,x,y`` and perhaps ``heading`` in metres and radians; or
    ``frame,latitude,longitude`` and perhaps ``course`` in degrees clockwise from north; or, with
    ``by_time``, RobotCar's ``timestamp,latitude,longitude`` and perhaps ``yaw`` in radians. Another
    table is a ValueError that names file and line."""
    key = "timestamp" if by_time else "frame"
    rows = csv.DictReader(io.StringIO(read_text(path)), restval="", skipinitialspace=True)
    poses, fixes = dict[str, Pose](), dict[str, Fix]()
    try:
        columns = rows.fieldnames or ()
        if repeated := next((column for column in columns if columns.count(column) > 1), ""):
            raise ValueError(f"two columns {repeated!r}")
        is_gps = {key, "latitude", "longitude"} <= set(columns)
        missing = {key, "x", "y"} - set(columns)
        if missing and not is_gps:
            raise ValueError(f"no column {min(missing)!r}; expected frame,x,y,heading")
        first, second, third = Fix._fields if is_gps else Pose._fields
        for row in rows:
            if any(more := row.get(None, ())):  # as by decimal commas, not by one at the end
                raise ValueError(f"more cells than columns: {','.join(more)}")
            if by_time:
                parse_number(row[key])
                if (row.get("ins_status") or _SURE) != _SURE:
                    continue
            x, y = parse_number(row[first]), parse_number(row[second])
            direction = parse_number(row.get("yaw" if by_time else third) or "nan")
            direction = math.degrees(direction) if by_time else direction
            if math.isnan(x) != math.isnan(y):
                raise ValueError(
                    f"{first} is {row[first]} and {second} is {row[second]}; "
                    "expected two numbers, or nan twice"
                )
            name, position = frame_key(row[key]), (x, y, direction)
            if is_gps and Fix(*position).is_known:
                fixes[name] = Fix(*position)
            if repr(poses.setdefault(name, Pose(*position))) != repr(Pose(*position)):  # also NaN
                raise ValueError(f"{key} {row[key]!r} has two poses")
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{path} line {rows.line_num}: {error}") from error
    if is_gps:
        converted = (projection or Projection()).poses([*fixes.values()])
        return dict.fromkeys(poses, UNKNOWN) | dict(zip(fixes, converted, strict=True))
    return poses


def frame_key(frame: str) -> str:
    """An id or a name without the suffix of a picture, in Unicode's form NFC."""
    path = PurePosixPath(frame)
    is_picture = path.suffix.lower() in IMAGE_SUFFIXES
    return normalize("NFC", frame.removesuffix(path.suffix) if is_picture else frame)


def read_trajectory(path: Path, projection: Projection | None = None) -> Trajectory:
    """The poses in a GPX file, or in a file of KITTI, KITTI-360, TUM, EuRoC or RobotCar, recognised
    by its first line. A file of another form is a ValueError that names the line.

    KITTI: the matrix ``(3, 4)`` from camera to world (x right, y down, z ahead). KITTI-360: the
    number of a frame, which counts as its time, and the matrix to a world whose z is up, ``(3, 4)``
    of the car, which looks along its x, or ``(4, 4)`` of a camera. TUM: ``time x y z qx qy qz qw``,
    z is up. EuRoC: nanoseconds, ``x y z qw qx qy qz``; the body's z is taken for the camera's.
    RobotCar's ``ins.csv`` and ``gps.csv``, and GPX (extra ``gps``): metres of UTM, the heading is
    the yaw or course; nothing is interpolated over more than 5 s, or between segments."""
    text, projection = read_text(path), projection or Projection()
    first = text.lstrip().partition("\n")[0]
    if path.suffix.lower() == ".gpx":
        with requiring("gps", f"{path} needs"), naming(path):
            return _parse_gpx(text, projection)
    if {"timestamp", "latitude", "longitude"} <= {*first.strip().split(",")}:
        located = read_poses(path, projection, by_time=True)
        timed = [(parse_number(t) * 1e-6, p) for t, p in located.items() if not math.isnan(p.x)]
        if not timed or timed != sorted(timed, key=itemgetter(0)):
            raise ValueError(f"{path}: expected positions in order of time")
        return Trajectory([pose for _, pose in timed], [time for time, _ in timed], _GAP_SECONDS)
    if first.startswith("$G"):
        raise ValueError(f"{path} holds sentences of NMEA; convert them to GPX (gpsbabel)")
    poses, stamps, is_first, counts = list[Pose](), list[float](), True, set[int]()
    is_euroc, by_number = "q_RS_w" in first, False
    for place, words in words_of(path, text.replace(",", " ")):
        is_header, is_first = is_first and _is_header(words), False
        if is_header:
            continue
        with naming(place):
            numbers = [parse_number(word) for word in words]
            counts.add(len(numbers))
            is_frame = len(words[0]) <= _FRAME_DIGITS and not is_euroc
            by_number = len(numbers) in _KITTI_360 and is_frame
            time, pose = _of_line(numbers, by_number, is_euroc)
            if time is None or not math.isnan(pose.x):
                poses.append(pose)
                stamps += [] if time is None else [time]
    in_order = all(before <= after for before, after in pairwise([*stamps, math.inf]))
    if stamps and (len(stamps) != len(poses) or len(counts) > 1 or not in_order):
        raise ValueError(f"{path}: expected lines of one form in order of time")
    if not poses:
        raise ValueError(f"{path} holds no poses")
    return Trajectory(poses, stamps, by_number=by_number)


def _of_line(numbers: list[float], by_number: bool, real_first: bool) -> tuple[float | None, Pose]:
    """The time of a line, if it has one, and its pose; unknown if a number is."""
    count = len(numbers)
    if count == _KITTI:
        return None, Y_DOWN.pose(numbers[3::4], numbers[2::4])
    time, *matrix = numbers
    if by_number:
        axis = matrix[0:12:4] if count == _KITTI_360[0] else matrix[2:12:4]
        return time, Z_UP.pose(matrix[3:12:4], axis)
    if count not in (_TUM, _EUROC):
        raise ValueError(
            f"expected 12 numbers (KITTI), 13 or 17 (KITTI-360) or 8 (TUM), got {count}"
        )
    x, y, z, *quaternion = numbers[1:_TUM]
    if any(map(math.isnan, numbers[1:_TUM])):
        return time, UNKNOWN
    if count == _EUROC or real_first:
        time, (real, i, j, k) = time * 1e-9, quaternion
    else:
        i, j, k, real = quaternion
    # the file holds camera to world, `optical_axis` expects the inverse
    return time, Z_UP.pose((x, y, z), optical_axis((real, -i, -j, -k)))


def _is_header(words: Sequence[str]) -> bool:
    """Whether a line names columns: no word of it is a number."""
    for word in words:
        with suppress(ValueError):
            parse_number(word)
            return False
    return True


def _parse_gpx(text: str, projection: Projection) -> Trajectory:
    import gpxpy

    if "<!" in text.replace("<!--", "").replace("<![CDATA[", ""):
        raise ValueError("expected GPX without a document type")  # its entities can grow
    for point in re.findall(r"<(?:\w+:)?trkpt\b[^<>]*", text):
        for number in re.findall(r"""\s(?:lat|lon)\s*=\s*["']([^"']*)""", point):
            parse_number(number)  # gpxpy reads also 1_0 and digits of other scripts
    fixes, stamps, starts = list[Fix](), list[float](), set[int]()
    for segment in (s for track in gpxpy.parse(text).tracks for s in track.segments):
        starts.add(len(fixes))
        for point in segment.points:
            number = len(fixes) + 1
            if point.time is None:
                raise ValueError(f"point {number} has no time, as 2026-05-01T10:00:00Z")
            time = point.time if point.time.tzinfo else point.time.replace(tzinfo=UTC)
            if stamps and time.timestamp() < stamps[-1]:
                raise ValueError(f"position {number} is earlier than the one before it")
            stamps.append(time.timestamp())
            course = math.nan if point.course is None else float(point.course)
            fixes.append(Fix(point.latitude, point.longitude, course))
    if not fixes:
        raise ValueError("holds no positions; expected track points")
    return Trajectory(projection.poses(fixes), stamps, _GAP_SECONDS, frozenset(starts))
