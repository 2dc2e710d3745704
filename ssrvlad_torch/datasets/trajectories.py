"""Poses of one drive in files of KITTI and TUM, and the poses of its frames."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..untrusted import parse_number, read_text
from .camera_poses import Y_DOWN, Z_UP, optical_axis
from .poses import UNKNOWN, Pose

_KITTI, _TUM = 12, 8
_MOST_SECONDS = 0.02
_UNITS = (1, 1e-3, 1e-6, 1e-9)
"""Seconds, milliseconds, microseconds and nanoseconds."""


class Trajectory(NamedTuple):
    """Poses of one drive.

    Attributes:
        poses: in order.
        stamps: time of each pose in seconds, increasing; empty if the n-th pose belongs to the
            n-th frame.
    """

    poses: list[Pose]
    stamps: list[float]

    def of_frames(self, names: Sequence[str]) -> list[Pose]:
        """The pose of each frame: the n-th pose, or with stamps the pose that is nearest in time.

        The nearest pose is used if it is at most 0.02 s away, as in TUM's own tools.

        Args:
            names: names of all frames of the drive, in order; with stamps, times in seconds, or
                whole numbers of milliseconds, microseconds or nanoseconds.

        Raises:
            ValueError: the numbers of frames and poses differ, a name is no time, or no unit, or
                several, give the frames poses.
        """
        if self.stamps:
            return self._at_times(names)
        if len(names) != len(self.poses):
            raise ValueError(f"expected {len(self.poses)} frames, one per pose, got {len(names)}")
        return self.poses

    def _at_times(self, names: Sequence[str]) -> list[Pose]:
        """The poses at the times that are names, in the unit in which the most frames have one."""
        whole = all(name.isdecimal() for name in names)
        found = {
            unit: [self._at(_time(name) * unit) for name in names]
            for unit in (_UNITS if whole else _UNITS[:1])
        }
        counts = {unit: sum(pose is not UNKNOWN for pose in found[unit]) for unit in found}
        most = max(counts.values())
        best = [poses for unit, poses in found.items() if counts[unit] == most]
        if not most or any(poses != best[0] for poses in best):
            problem = "several units of time fit" if most else "no pose is near in time to"
            raise ValueError(
                f"{problem} the {len(names)} frames, for example {names[0]!r}; expected names in "
                f"seconds between {self.stamps[0]} and {self.stamps[-1]}, or in ms, us or ns"
            )
        return best[0]

    def _at(self, time: float) -> Pose:
        index = bisect_left(self.stamps, time)
        around = range(max(0, index - 1), min(len(self.stamps), index + 1))
        nearest = min(around, key=lambda n: abs(self.stamps[n] - time))
        near = abs(self.stamps[nearest] - time) <= _MOST_SECONDS
        return self.poses[nearest] if near else UNKNOWN


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory in a file of KITTI or TUM, recognised by the count of numbers in a line.

    KITTI: twelve numbers, the matrix ``(3, 4)`` from the camera to the world of the first camera (x
    to the right, y down, z ahead). TUM: ``time x y z qx qy qz qw``, the camera in a world whose z
    is up. The heading is the direction of the camera's z axis.

    Raises:
        ValueError: the file has another form; the message names the line.
    """
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
    return Trajectory(poses, stamps)


def _time(name: str) -> float:
    try:
        return parse_number(name)
    except ValueError:
        raise ValueError(f"expected frames named by their time in seconds, got {name!r}") from None
