"""Poses of frames: positions of GPS (WGS 84) as metres of UTM, which need the extra ``gps``, also
from EXIF tags, and names of files that hold the position of an image.

Names have the form of VPR-methods-evaluation: ``@ UTM east @ UTM north @ zone number @ zone letter
@ latitude @ longitude @ panorama @ tile @ heading @ pitch @ roll @ height @ time stamp @ note
@.jpg``; all but the first two may be missing. The heading is in degrees clockwise from north."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
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

    @property
    def is_known(self) -> bool:
        """Whether there is a position: no NaN, nor 0 twice; out of range is a ValueError."""
        latitude, longitude, _ = self
        if math.isnan(latitude) or math.isnan(longitude) or latitude == longitude == 0:
            return False
        for name, value, (low, high) in zip(self._fields, self, _RANGES, strict=False):
            if not low <= value <= high:
                raise ValueError(f"{name} {value} out of range; expected {low} to {high}")
        return True


NOWHERE = Fix(math.nan, math.nan)
_RANGES = (-80, 84), (-180, 180)
"""Degrees of latitude, in UTM, and of longitude."""


def parse_number(text: str) -> float:
    """The number in a text, also ``nan``; not ``inf``, ``1_000`` or other scripts' digits."""
    if "_" in text or not text.isascii():
        raise ValueError(f"could not convert string to float: {text!r}")
    if math.isinf(number := float(text)):
        raise ValueError(f"expected a finite number, got {text}")
    return number


class Projection:
    """Positions of GPS (WGS 84) in metres of UTM, all in one zone: of those around the median of
    the first positions the one in which it is nearest to a known pose, or else its own."""

    def __init__(self, near: Callable[[], Pose] = lambda: UNKNOWN) -> None:
        self._near = near
        self._zone: tuple[int, bool] | None = None

    def poses(self, fixes: Sequence[Fix]) -> list[Pose]:
        """The poses at positions, unknown where these are; no extra ``gps`` is an ImportError."""
        places = [fix for fix in fixes if fix.is_known]
        if places and self._zone is None:
            self._zone = self._zone_of(median(f[0] for f in places), median(f[1] for f in places))
        zone = self._zone or (0, True)
        return [
            Pose(*_utm(fix.latitude, fix.longitude, zone), heading_of_course(fix.course))
            if fix.is_known
            else UNKNOWN
            for fix in fixes
        ]

    def _zone_of(self, latitude: float, longitude: float) -> tuple[int, bool]:
        with requiring("gps", "latitudes need"):
            import utm
        number, near = utm.latlon_to_zone_number(latitude, longitude), self._near()
        zones = [((number + d - 1) % 60 + 1, s) for d in (0, -1, 1) for s in (True, False)]
        zones.sort(key=lambda zone: zone != (number, latitude >= 0))
        if not math.isnan(near.x):
            zones.sort(key=lambda z: math.dist(_utm(latitude, longitude, z), (near.x, near.y)))
        return zones[0]


def _utm(latitude: float, longitude: float, zone: tuple[int, bool]) -> tuple[float, float]:
    """Metres east and north in a zone: its number, and whether it is the northern one."""
    import utm

    number, is_northern = zone
    east, north, *_ = utm.from_latlon(latitude, longitude, number, force_northern=is_northern)
    return float(east), float(north)


def heading_of_course(course: float) -> float:
    """The heading in radians from east of a course in degrees clockwise from north."""
    return math.remainder(math.radians(90 - course), math.tau)


def read_exif(file: Path | BinaryIO) -> Fix:
    """The position and direction in an image's EXIF tags, or `NOWHERE`."""
    tag = ExifTags.GPS
    with suppress(Exception):  # damaged files raise any exception
        with Image.open(file) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(tags[tag.GPSLatitude], tags[tag.GPSLatitudeRef], "NS")
        longitude = _degrees(tags[tag.GPSLongitude], tags[tag.GPSLongitudeRef], "EW")
        is_true = tags.get(tag.GPSImgDirectionRef, "T") == "T"
        course = float(tags.get(tag.GPSImgDirection, "nan")) if is_true else math.nan
        fix = Fix(latitude, longitude, course if 0 <= course <= 360 else math.nan)
        if tags.get(tag.GPSStatus) != "V" and fix.is_known:  # V, void: no reception
            return fix
    return NOWHERE


def _degrees(numbers: Sequence[float], letter: str, letters: str) -> float:
    """An angle of three numbers and one of two letters, of which the second is negative."""
    degrees, minutes, seconds = map(float, numbers)
    is_valid = degrees >= 0 and 0 <= minutes <= 60 and 0 <= seconds <= 60
    if not is_valid or letter not in tuple(letters):
        raise ValueError(f"{degrees} {minutes} {seconds} {letter} is no angle")
    return (degrees + minutes / 60 + seconds / 3600) * (1 if letter == letters[0] else -1)


_ZONE, _HEADING, _TIME, _NOTE = 3, 9, 13, 14
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


def zone_of_name(name: str) -> str:
    """The number of the UTM zone in a file name without its suffix; empty if there is none."""
    return name.split("@")[_ZONE] if name.count("@") > _ZONE and name.startswith("@") else ""


def write_name(name: str, pose: Pose, stamp: float = math.nan) -> str:
    """A file name that holds the pose, the time if it is known, and ``name`` as its note.

    Examples:
        >>> write_name("000007", Pose(303189.3, 5787193.0, 0.0))
        '@0303189.30@5787193.00@@@@@@@90.00@@@@@000007@'
    """
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
