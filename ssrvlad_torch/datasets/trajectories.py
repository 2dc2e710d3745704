"""Poses of one drive in files of KITTI, TUM, GPX and NMEA, and the poses of its frames."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, chain
from pathlib import Path

from ..files import read_text
from .camera_poses import Y_DOWN, Z_UP, optical_axis
from .poses import UNKNOWN, Pose, parse_number, poses_of_fixes
from .tracks import SUFFIXES, read_track

_KITTI, _TUM = 12, 8
_MOST_SECONDS = 0.02
_GAP = 5.0
"""Seconds between two positions of a GPS receiver, up to which positions are interpolated; a
receiver gives one a second."""
_UNITS = (1, 1e-3, 1e-6, 1e-9)
"""Seconds, milliseconds, microseconds and nanoseconds."""


@dataclass(frozen=True)
class Trajectory:
    """Poses of one drive. A gap that is NaN or negative is a ValueError.

    Attributes:
        poses: in order.
        stamps: time of each pose in seconds, increasing; empty if the n-th pose belongs to the
            n-th frame.
        largest_gap: between two poses at most this many seconds apart a frame's pose is
            interpolated, its heading along the shorter arc; elsewhere it is unknown. ``None``: the
            nearest pose is used if it is at most 0.02 s away, as in TUM's own tools.
        starts: places of poses before which nothing was recorded: none is interpolated there.
    """

    poses: list[Pose]
    stamps: list[float]
    largest_gap: float | None = None
    starts: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        if self.largest_gap is not None and not self.largest_gap >= 0:
            raise ValueError(f"expected a largest gap of 0 seconds or more, got {self.largest_gap}")

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
        whole = all(name.isdecimal() for name in names)
        timed = bool(stamps) and not any(map(math.isnan, stamps))
        times = [stamps] if timed else []
        if whole or not timed:
            try:
                seconds = [parse_number(name) for name in names]
            except ValueError as error:
                raise ValueError(
                    f"expected frames named by their time in seconds: {error}"
                ) from None
            named = [[t * unit for t in seconds] for unit in (_UNITS if whole else _UNITS[:1])]
            times += [given for given in named if not (timed and _are_same(given, stamps))]
        drives = [[self._at(time) for time in given] for given in times]
        # in too small a unit all frames of a drive are near its first pose
        reached = [
            len({bisect_left(self.stamps, t) for t, pose in pairs if pose is not UNKNOWN})
            for pairs in map(zip, times, drives)
        ]
        most = max(reached)
        best = [poses for poses, count in zip(drives, reached, strict=True) if count == most]
        if not most or any(poses != best[0] for poses in best):
            problem = "several units of time fit" if most else "no pose is near in time to"
            raise ValueError(
                f"{problem} the {len(names)} frames, for example {names[0]!r}; expected names in "
                f"seconds between {self.stamps[0]} and {self.stamps[-1]}, or in ms, us or ns, or a "
                "video or bag of that time"
            )
        return best[0]

    def _at(self, time: float) -> Pose:
        after = bisect_left(self.stamps, time)  # the first pose that is not before the time
        around = range(max(0, after - 1), min(len(self.stamps), after + 1))
        nearest = min(around, key=lambda n: abs(self.stamps[n] - time))
        if self.largest_gap is None:
            near = abs(self.stamps[nearest] - time) <= _MOST_SECONDS
            return self.poses[nearest] if near else UNKNOWN
        if self.stamps[nearest] == time:
            return self.poses[nearest]
        seconds = self.stamps[around[-1]] - self.stamps[around[0]]
        if len(around) == 1 or seconds > self.largest_gap or after in self.starts:
            return UNKNOWN
        before, following = self.poses[after - 1], self.poses[after]
        fraction = (time - self.stamps[after - 1]) / seconds
        turn = math.remainder(following.heading - before.heading, math.tau)
        return Pose(
            before.x + fraction * (following.x - before.x),
            before.y + fraction * (following.y - before.y),
            math.remainder(before.heading + fraction * turn, math.tau),
        )


def _are_same(times: Sequence[float], stamps: Sequence[float]) -> bool:
    """Whether times are those of stamps, as in the names of a video's frames, in microseconds."""
    return all(abs(time - stamp) <= _UNITS[2] for time, stamp in zip(times, stamps, strict=True))


def read_trajectory(path: Path, largest_gap: float | None = None) -> Trajectory:
    """The trajectory in a GPX or NMEA file, by its suffix, see `tracks`; or in a file of KITTI or
    TUM, recognised by the count of numbers in a line. A file of another form is a ValueError that
    names the line.

    KITTI: twelve numbers, the matrix ``(3, 4)`` from the camera to the world of the first camera (x
    to the right, y down, z ahead). TUM: ``time x y z qx qy qz qw``, the camera in a world whose z
    is up. The heading is the direction of the camera's z axis. GPX and NMEA: east and north in
    metres of UTM; the heading is the course, unknown where the file has none. The largest gap, see
    `Trajectory`, is 5 s for these by default; between segments of GPX no gap is bridged.
    """
    if path.suffix.lower() in SUFFIXES:
        segments = read_track(path)
        times, fixes = zip(*chain(*segments), strict=True)
        gap = _GAP if largest_gap is None else largest_gap
        starts = frozenset(accumulate(map(len, segments)))
        try:
            return Trajectory(poses_of_fixes(fixes), list(times), gap, starts)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    poses, stamps = list[Pose](), list[float]()
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            numbers = [parse_number(word) for word in words]
            if len(numbers) == _KITTI:
                poses.append(Y_DOWN.pose(numbers[3::4], numbers[2::4]))
            elif len(numbers) == _TUM:
                x, y, z, w = numbers[4:]
                # the file holds camera to world, `optical_axis` expects the inverse
                poses.append(Z_UP.pose(numbers[1:4], optical_axis((w, -x, -y, -z))))
                stamps.append(numbers[0])
            else:
                raise ValueError(f"expected 12 numbers (KITTI) or 8 (TUM), got {len(numbers)}")
        except ValueError as error:
            raise ValueError(f"{path} line {number}: {error}") from error
    if stamps and (len(stamps) != len(poses) or stamps != sorted(stamps)):
        raise ValueError(f"{path}: expected lines of 8 numbers in order of time")
    if not poses:
        raise ValueError(f"{path} holds no poses")
    return Trajectory(poses, stamps, largest_gap)
