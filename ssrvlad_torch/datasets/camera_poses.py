"""Camera poses in space, as data sets store them, projected on the ground plane."""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from ..files import naming, read_bytes, read_json
from .poses import UNKNOWN, Pose, heading_of_course, parse_number

_EARTH_RADIUS = 6_371_000
"""Metres."""
_MERIDIAN = 9.0


class Ground(NamedTuple):
    """The axes of a world that become x and y of a `Pose`, y to the left of x seen from above."""

    x: int
    y: int

    def pose(self, centre: Sequence[float], axis: Sequence[float]) -> Pose:
        """The pose of a camera by its centre ``(3,)`` in metres and its optical axis ``(3,)``."""
        return Pose(centre[self.x], centre[self.y], math.atan2(axis[self.y], axis[self.x]))


Z_UP = Ground(0, 1)
Z_DOWN = Ground(1, 0)
Y_DOWN = Ground(0, 2)
Y_UP_LEFT_HANDED = Ground(0, 2)


def axes_of(quaternion: Sequence[float]) -> list[tuple[float, float, float]]:
    """The axes of a camera (x right, y down, z ahead) in the world: the rows of the rotation from
    world to camera, a quaternion ``(w, x, y, z)`` of any length but 0, else a ValueError."""
    length = math.hypot(*quaternion)
    if not 0 < length < math.inf:
        raise ValueError(f"quaternion {tuple(quaternion)} is not a rotation")
    w, x, y, z = (number / length for number in quaternion)
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]


def optical_axis(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """The axis along which a camera looks, its own +z; see `axes_of`."""
    return axes_of(quaternion)[2]


def words_of(path: Path, text: str) -> Iterator[tuple[str, list[str]]]:
    """Place, "PATH line NUMBER", and words of each line that is not empty or a ``#`` comment."""
    for number, line in enumerate(text.splitlines(), 1):
        if (words := line.split()) and not words[0].startswith("#"):
            yield f"{path} line {number}", words


def parse_numbers(words: Sequence[str], count: int) -> list[float]:
    """Exactly ``count`` numbers; other words or another count are a ValueError."""
    if len(words) != count:
        raise ValueError(f"expected {count} numbers, got {len(words)}")
    return [parse_number(word) for word in words]


def read_colmap(path: Path, text: str) -> dict[str, Pose]:
    """Poses by image name of COLMAP's ``images.txt``: lines ``id qw qx qy qz tx ty tz camera name``
    from world to camera, each before one of points. Upright cameras tell which axis is vertical."""
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]
    cameras = dict[str, tuple[list[float], list[tuple[float, float, float]]]]()
    for number, line in lines[::2]:
        with naming(f"{path} line {number}"):
            words = line.split(maxsplit=9)
            if len(words) < 10:
                raise ValueError(f"expected 9 numbers and the name of an image, got {line[:80]!r}")
            numbers = parse_numbers(words[1:8], 7)
            axes, shift = axes_of(numbers[:4]), numbers[4:]
            centre = [-sum(a[i] * t for a, t in zip(axes, shift, strict=True)) for i in range(3)]
            cameras[words[9].strip()] = centre, axes
    down = [sum(axes[1][i] for _, axes in cameras.values()) for i in range(3)]
    vertical = max(range(3), key=lambda axis: abs(down[axis]))
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    ground = Ground(second, first) if down[vertical] > 0 else Ground(first, second)
    return {name: ground.pose(centre, axes[2]) for name, (centre, axes) in cameras.items()}


def read_cmu_list(path: Path) -> dict[str, Pose]:
    """Poses of Extended CMU Seasons by image name without suffix, from lines ``name qw qx qy qz cx
    cy cz``: the rotation from world to camera and the camera's centre, in a world whose z is up."""
    poses = _read_lines(path, 7, lambda line: Z_UP.pose(line[4:], optical_axis(line[:4])))
    return {Path(name).stem.removesuffix("_rect"): pose for name, pose in poses.items()}


def read_nvm(path: Path) -> dict[str, Pose]:
    """Poses of RobotCar Seasons by ``<condition>/<camera>/<name>``, of a model of VisualSFM: lines
    ``name focal qw qx qy qz cx cy cz distortion 0``, world to camera, in a world whose z points
    down. Another or a cut file is a ValueError that names file and line."""
    poses = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        if not file.readline().startswith("NVM_V3"):
            raise ValueError(f"{path} is not an NVM_V3 model")
        lines = ((n, words) for n, line in enumerate(file, 2) if (words := line.split()))
        number, (text, *_) = next(lines, (1, ["no number of cameras"]))
        with naming(f"{path} line {number}"):
            missing = int(text)
        for number, (name, *words) in islice(lines, missing):
            with naming(f"{path} line {number}"):
                numbers, missing = parse_numbers(words, 10), missing - 1
                poses[_plain(name)] = Z_DOWN.pose(numbers[5:8], optical_axis(numbers[1:5]))
    if missing:
        raise ValueError(f"{path} ends {missing} cameras too early")
    return poses


def read_v2_poses(path: Path) -> dict[str, Pose]:
    """The same of version 2, from lines of a name and the 4 x 4 matrix from camera to world."""
    poses = _read_lines(path, 16, lambda line: Z_DOWN.pose(line[3:12:4], line[2:11:4]))
    return {_plain(name): pose for name, pose in poses.items()}


def read_matrix(path: Path) -> Pose:
    """The pose of a frame of SYNTHIA: a 4 x 4 matrix from camera to world, column by column. The
    world, of Unity, is left-handed with y up, and a camera looks along its own -z."""
    with naming(path):
        matrix = parse_numbers(path.read_text(encoding="utf-8", errors="replace").split(), 16)
    return Y_UP_LEFT_HANDED.pose(matrix[12:15], [-number for number in matrix[8:11]])


def read_fix(path: Path) -> Pose:
    """The pose of a frame of Cityscapes in metres, by a transverse Mercator projection of a sphere
    at 9 degrees east: distances are wrong by at most 0.5 %. Missing numbers are a ValueError."""
    try:
        fix = read_json(path)
        latitude, longitude = fix["gpsLatitude"], fix["gpsLongitude"]
        if latitude == longitude == 0:  # no reception
            return UNKNOWN
        phi, along = math.radians(latitude), math.radians(longitude)
        along -= math.radians(_MERIDIAN)
        east = _EARTH_RADIUS * math.atanh(math.cos(phi) * math.sin(along))
        north = _EARTH_RADIUS * math.atan2(math.tan(phi), math.cos(along))
        return Pose(east, north, heading_of_course(fix.get("gpsHeading", math.nan)))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} must hold numbers gpsLatitude, gpsLongitude and gpsHeading: {error!r}"
        ) from error


def _read_lines(path: Path, count: int, pose: Callable[[list[float]], Pose]) -> dict[str, Pose]:
    """Poses by name, of lines of a name and ``count`` numbers, which ``pose`` converts."""
    poses = {}
    for place, (name, *words) in words_of(path, read_bytes(path).decode("utf-8", "replace")):
        with naming(place):
            poses[name] = pose(parse_numbers(words, count))
    return poses


def _plain(name: str) -> str:
    """A name without ``./`` and suffix: the models name PNGs, ``./<condition>/...png``."""
    return str(Path(name).with_suffix(""))
