"""Poses of one sequence in files of KITTI, TUM and GPX, and the poses of its frames."""

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..files import naming, read_text, requiring
from .camera_poses import Y_DOWN, Z_UP, optical_axis, words_of
from .poses import UNKNOWN, Fix, Pose, Projection, parse_number

_KITTI, _TUM = 12, 8
"""Numbers in a line."""
_NEAREST_SECONDS = 0.02
_GAP = 5.0
"""Seconds between two positions of a GPS receiver, up to which positions are interpolated; a
receiver gives one a second."""
_UNITS = (1, 1e-3, 1e-6, 1e-9)
"""Seconds, milliseconds, microseconds and nanoseconds."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of one sequence.

    Attributes:
        poses: in order.
        stamps: time of each pose in seconds, increasing; empty if the n-th pose belongs to the
            n-th frame.
        gap: between two poses at most this many seconds apart a frame's pose is interpolated, its
            heading along the shorter arc; elsewhere it is unknown. ``None``: the nearest pose is
            used if it is at most 0.02 s away, as in TUM's own tools.
        starts: places of poses before which nothing was recorded: none is interpolated there.
    """

    poses: list[Pose]
    stamps: list[float]
    gap: float | None = None
    starts: frozenset[int] = frozenset()

    def of_frames(self, names: Sequence[str], stamps: Sequence[float] = ()) -> list[Pose]:
        """The pose of each frame: the n-th pose, or, if poses have stamps, the pose at its time,
        which is one of ``stamps`` in seconds or its name, in seconds or a whole number of milli-,
        micro- or nanoseconds, whichever unit reaches most of the trajectory. Other numbers of
        frames than poses, a name that is no time, no unit that gives poses, and two that reach as
        much of it and give different poses are a ValueError."""
        if not self.stamps:
            if len(names) != len(self.poses):
                expected = f"expected {len(self.poses)} frames, one per pose"
                raise ValueError(f"{expected}, got {len(names)}")
            return self.poses
        by_unit = [self._reached(times) for times in _times_of(names, stamps)]
        most = max(count for count, _ in by_unit)
        best = [poses for count, poses in by_unit if count == most]
        if not most or any(poses != best[0] for poses in best):
            problem = "several units of time fit" if most else "no pose is near in time to"
            raise ValueError(
                f"{problem} the {len(names)} frames, for example {names[0]!r}; expected names in "
                f"seconds between {self.stamps[0]} and {self.stamps[-1]}, or in ms, us or ns, or a "
                "video or bag of that time"
            )
        return best[0]

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
        if self.gap is None:
            near = abs(self.stamps[nearest] - time) <= _NEAREST_SECONDS
            return self.poses[nearest] if near else UNKNOWN
        if self.stamps[nearest] == time:
            return self.poses[nearest]
        seconds = self.stamps[around[-1]] - self.stamps[around[0]]
        if len(around) == 1 or seconds > self.gap or after in self.starts:
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
    """What the times of frames can be: their stamps, and their names in each unit; but not names
    that repeat the stamps, as those of a video's frames in microseconds."""
    whole = all(name.isdecimal() for name in names)
    timed = bool(stamps) and not any(map(math.isnan, stamps))
    if timed and not whole:
        return [stamps]
    with naming("expected frames named by their time in seconds"):
        seconds = [parse_number(name) for name in names]
    times: list[Sequence[float]] = [stamps] if timed else []
    for unit in _UNITS if whole else _UNITS[:1]:
        named = [number * unit for number in seconds]
        if not timed or np.abs(np.subtract(named, stamps)).max() > _UNITS[2]:
            times.append(named)
    return times


def read_trajectory(path: Path, projection: Projection | None = None) -> Trajectory:
    """The trajectory in a GPX file, by its suffix; or in a file of KITTI or TUM, recognised by the
    count of numbers in a line. A file of another form is a ValueError that names the line.

    KITTI: twelve numbers, the matrix ``(3, 4)`` from the camera to the world of the first camera (x
    to the right, y down, z ahead). TUM: ``time x y z qx qy qz qw``, the camera in a world whose z
    is up. The heading is the direction of the camera's z axis. GPX, which needs the extra ``gps``:
    east and north in metres of UTM; the heading is the course, unknown where the file has none;
    between its segments nothing is interpolated.
    """
    text = read_text(path)
    if path.suffix.lower() == ".gpx":
        return _read_gpx(path, text, projection or Projection())
    poses, stamps = list[Pose](), list[float]()
    for place, words in words_of(path, text.replace(",", " ")):
        with naming(place):
            numbers = [parse_number(word) for word in words]
            if len(numbers) == _KITTI:
                poses.append(Y_DOWN.pose(numbers[3::4], numbers[2::4]))
            elif len(numbers) == _TUM:
                time, x, y, z, *(i, j, k, real) = numbers
                # the file holds camera to world, `optical_axis` expects the inverse
                poses.append(Z_UP.pose((x, y, z), optical_axis((real, -i, -j, -k))))
                stamps.append(time)
            else:
                raise ValueError(f"expected 12 numbers (KITTI) or 8 (TUM), got {len(numbers)}")
    in_order = all(before <= after for before, after in pairwise([*stamps, math.inf]))
    if stamps and (len(stamps) != len(poses) or not in_order):
        raise ValueError(f"{path}: expected lines of 8 numbers in order of time")
    if not poses:
        raise ValueError(f"{path} holds no poses")
    return Trajectory(poses, stamps)


def _read_gpx(path: Path, text: str, projection: Projection) -> Trajectory:
    with requiring("gps", f"{path} needs"), naming(path):
        points = list(_track_points(text))
        if not points:
            raise ValueError("holds no positions; expected track points")
        segments, times, fixes = zip(*points, strict=True)
        for number, (before, after) in enumerate(pairwise(times), 2):
            if after < before:
                raise ValueError(f"position {number} is earlier than the one before it")
        starts = (n for n, (a, b) in enumerate(pairwise(segments), 1) if a != b)
        poses = list(map(projection.pose, fixes))
    return Trajectory(poses, list(times), _GAP, frozenset(starts))


def _track_points(text: str) -> Iterator[tuple[int, float, Fix]]:
    """Number of the segment, seconds since 1970 UTC, and position of each point."""
    import gpxpy

    if "<!" in text.replace("<!--", "").replace("<![CDATA[", ""):
        raise ValueError("expected GPX without a document type")  # its entities can grow
    segments = (segment for track in gpxpy.parse(text).tracks for segment in track.segments)
    points = ((n, point) for n, segment in enumerate(segments) for point in segment.points)
    for number, (segment, point) in enumerate(points, 1):
        time: datetime | None = point.time
        if time is None:
            raise ValueError(f"point {number} has no time, as 2026-05-01T10:00:00Z")
        time = time if time.tzinfo else time.replace(tzinfo=UTC)
        course = math.nan if point.course is None else float(point.course)
        yield segment, time.timestamp(), Fix(point.latitude, point.longitude, course)
