"""Camera poses in space, as data sets store them, projected on the ground plane."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..files import naming, read_bytes
from .poses import Pose, parse_number


class Ground(NamedTuple):
    """The numbers, 0 to 2, of the axes of a world that span its ground plane: those that become x
    and y of a `Pose`, y to the left of x seen from above."""

    x: int
    y: int

    def pose(self, centre: Sequence[float], axis: Sequence[float]) -> Pose:
        """The pose of a camera by its centre ``(3,)`` in metres and its optical axis ``(3,)``."""
        return Pose(centre[self.x], centre[self.y], math.atan2(axis[self.y], axis[self.x]))


Z_UP = Ground(0, 1)
Z_DOWN = Ground(1, 0)
Y_DOWN = Ground(0, 2)
Y_UP_LEFT_HANDED = Ground(0, 2)


def optical_axis(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """Optical axis, a unit vector in the world, of a camera that looks along its own +z: the third
    row of the rotation from world to camera (COLMAP and VisualSFM: x to the right, y down, z
    ahead), given as a quaternion ``(w, x, y, z)`` of any length but 0, else a ValueError."""
    length = math.hypot(*quaternion)
    if not 0 < length < math.inf:
        raise ValueError(f"quaternion {tuple(quaternion)} is not a rotation")
    w, x, y, z = (number / length for number in quaternion)
    return 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


def read_poses(path: Path, count: int, pose: Callable[[list[float]], Pose]) -> dict[str, Pose]:
    """Poses by name, from lines of a name and ``count`` numbers that ``pose`` converts; lines that
    begin with ``#`` are comments. A line of another form is a ValueError that names file and
    line."""
    poses = {}
    for place, (name, *words) in words_of(path, read_bytes(path).decode("utf-8", "replace")):
        with naming(place):
            poses[name] = pose(parse_numbers(words, count))
    return poses


def words_of(path: Path, text: str) -> Iterator[tuple[str, list[str]]]:
    """The words of each line of a file, with its place, "PATH line NUMBER"; without empty lines and
    those that begin with ``#``."""
    for number, line in enumerate(text.splitlines(), 1):
        if (words := line.split()) and not words[0].startswith("#"):
            yield f"{path} line {number}", words


def parse_numbers(words: Sequence[str], count: int) -> list[float]:
    """Exactly ``count`` numbers; other words or another count are a ValueError."""
    if len(words) != count:
        raise ValueError(f"expected {count} numbers, got {len(words)}")
    return [parse_number(word) for word in words]
