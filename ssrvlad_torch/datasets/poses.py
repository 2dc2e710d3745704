"""Poses of frames: positions of GPS (WGS 84) as metres of UTM, which need the extra ``gps``, also
from EXIF tags, and names of files that hold the position of an image.

Names have the form of VPR-methods-evaluation: ``@ UTM east @ UTM north @ zone number @ zone letter
@ latitude @ longitude @ panorama @ tile @ heading @ pitch @ roll @ height @ time stamp @ note
@.jpg``; all but the first two may be empty or missing. The heading is in degrees clockwise from
north.
"""

import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, NamedTuple

from PIL import ExifTags, Image

from ..files import requiring


class Pose(NamedTuple):
    """Pose of a camera on the ground plane: metres, and radians counter-clockwise from +x."""

    x: float
    y: float
    heading: float


UNKNOWN = Pose(float("nan"), float("nan"), float("nan"))


class Fix(NamedTuple):
    """Latitude, longitude and course in degrees; the course is clockwise from north, or NaN."""

    latitude: float
    longitude: float
    course: float = math.nan


def parse_number(text: str) -> float:
    """The number that a text is, also ``nan``. Unlike `float`, it refuses ``inf``, ``1_000`` and
    digits of other scripts; all are a ValueError."""
    if "_" in text or not text.isascii():
        raise ValueError(f"could not convert string to float: {text!r}")
    if math.isinf(number := float(text)):
        raise ValueError(f"expected a finite number, got {text}")
    return number


class Projection:
    """Positions of GPS (WGS 84) as poses in metres of UTM, all in one zone: of the zones around the
    first position that in which it is nearest to a pose that is known, of the map for example;
    without one, its own. Needs the extra ``gps``."""

    def __init__(self, near: Callable[[], Pose] = lambda: UNKNOWN) -> None:
        self._near = near
        self._zone: tuple[int, bool] | None = None

    def pose(self, fix: Fix) -> Pose:
        """The pose at a position, unknown where it is NaN or, as receivers say without reception, 0
        twice. One outside UTM is a ValueError; without the extra ``gps``, an ImportError."""
        latitude, longitude, course = fix
        if math.isnan(latitude) or math.isnan(longitude) or latitude == longitude == 0:
            return UNKNOWN
        with requiring("gps", "latitudes need"):
            import utm
        if self._zone is None:
            number, near = utm.latlon_to_zone_number(latitude, longitude), self._near()
            zones = [((number + d - 1) % 60 + 1, s) for d in (0, -1, 1) for s in (True, False)]
            zones.sort(key=lambda zone: zone != (number, latitude >= 0))
            if not math.isnan(near.x):
                zones.sort(key=lambda z: math.dist(_utm(latitude, longitude, z), (near.x, near.y)))
            self._zone = zones[0]
        return Pose(*_utm(latitude, longitude, self._zone), heading_of_course(course))


def _utm(latitude: float, longitude: float, zone: tuple[int, bool]) -> tuple[float, float]:
    """Metres east and north in a zone: its number, and whether it is the northern one."""
    import utm

    number, is_northern = zone
    east, north, *_ = utm.from_latlon(latitude, longitude, number, force_northern=is_northern)
    return float(east), float(north)


def heading_of_course(course: float) -> float:
    """The heading in radians, counter-clockwise from +x (east), of a course in degrees clockwise
    from north. The difference between grid north and true north, up to 3 degrees, is ignored."""
    return math.remainder(math.radians(90 - course), math.tau)


def read_exif(file: Path | BinaryIO) -> Fix | None:
    """The position and direction in the EXIF tags of an image; ``None`` without a valid position. A
    direction from magnetic north is ignored."""
    tag = ExifTags.GPS
    try:
        with Image.open(file) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        if tags.get(tag.GPSStatus) == "V":  # void: no reception
            return None
        latitude = _degrees(tags[tag.GPSLatitude], tags[tag.GPSLatitudeRef])
        longitude = _degrees(tags[tag.GPSLongitude], tags[tag.GPSLongitudeRef])
        is_true = tags.get(tag.GPSImgDirectionRef, "T") == "T"
        course = float(tags.get(tag.GPSImgDirection, "nan")) if is_true else math.nan
        return Fix(latitude, longitude, course)
    except Exception:  # damaged files raise any exception
        return None


def _degrees(parts: Sequence[float], hemisphere: str) -> float:
    degrees, minutes, seconds = map(float, parts)
    angle = degrees + minutes / 60 + seconds / 3600
    return -angle if hemisphere in ("S", "W") else angle


_HEADING, _TIME, _NOTE = 9, 13, 14
_FIELDS = 15
_TIME_FORMAT = "%Y%m%d_%H%M%S"


def read_name(name: str) -> tuple[Pose, float]:
    """The pose and the time in seconds from a file name without its suffix; NaN where missing.
    Both are NaN if the name does not begin with ``@``, two numbers and ``@``.

    Examples:
        >>> read_name("@0303189.3@5787193.0@31@U@@@@@90@@@@@@")[0]
        Pose(x=303189.3, y=5787193.0, heading=0.0)
    """
    if not name.startswith("@"):
        return UNKNOWN, math.nan
    fields = name.split("@") + [""] * _FIELDS
    x, y, course = (_number(fields[n]) for n in (1, 2, _HEADING))
    if math.isnan(x + y):
        return UNKNOWN, math.nan
    try:
        time = datetime.strptime(fields[_TIME], _TIME_FORMAT).replace(tzinfo=UTC).timestamp()
    except ValueError:  # some data sets have only a year or a month
        time = math.nan
    return Pose(x, y, heading_of_course(course)), time


def write_name(name: str, pose: Pose, stamp: float = math.nan) -> str:
    """A file name that holds the pose, the time if it is known, and ``name`` as its note. An
    unknown position is a ValueError.

    Examples:
        >>> write_name("000007", Pose(303189.3, 5787193.0, 0.0))
        '@0303189.30@5787193.00@@@@@@@90.00@@@@@000007@'
    """
    if math.isnan(pose.x) or math.isnan(pose.y):
        raise ValueError(f"{name} has no known position")
    fields = [""] * _FIELDS
    fields[1], fields[2] = f"{pose.x:010.2f}", f"{pose.y:010.2f}"
    if not math.isnan(pose.heading):
        fields[_HEADING] = f"{(90 - math.degrees(pose.heading)) % 360:.2f}"
    if not math.isnan(stamp):
        fields[_TIME] = datetime.fromtimestamp(stamp, UTC).strftime(_TIME_FORMAT)
    fields[_NOTE] = name.replace("@", "_")
    return "@".join([*fields, ""])


def _number(text: str) -> float:
    try:
        return parse_number(text)
    except ValueError:
        return math.nan
