"""GPS positions (WGS 84) as metres of UTM. Needs the extra ``gps``."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import ExifTags, Image

from ..files import check_regular, requiring

_KILOMETRE = 1 / 111.2
"""Degrees of latitude."""


class Fix(NamedTuple):
    """Latitude, longitude and course in degrees; the course is clockwise from north, or NaN."""

    latitude: float
    longitude: float
    course: float = math.nan


def eastings_northings(fixes: Sequence[Fix]) -> list[tuple[float, float]]:
    """UTM coordinates ``(east, north)`` in metres of the fixes of one drive. A position outside
    UTM, or within 1 km of the border of a zone, across which coordinates of other drives would not
    compare, is a ValueError; without the extra ``gps``, an ImportError."""
    with requiring("gps", "latitudes need"):
        import utm
    positions = [utm.from_latlon(fix.latitude, fix.longitude) for fix in fixes]
    zones = set[tuple[int, bool]]()
    for latitude, longitude, _ in fixes:  # and about 1 km from it in each direction
        wide = _KILOMETRE / max(math.cos(math.radians(latitude)), _KILOMETRE)
        for up, right in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            north, east = latitude + up * _KILOMETRE, longitude + right * wide
            zones.add((utm.latlon_to_zone_number(north, east), north < 0))
    if len(zones) > 1:
        raise ValueError(
            "the drive comes within 1 km of the border of a UTM zone; expected x and y in metres"
        )
    return [(float(east), float(north)) for east, north, _, _ in positions]


def heading_of_course(course: float) -> float:
    """The heading in radians, counter-clockwise from +x (east), of a course in degrees clockwise
    from north. The difference between grid north and true north, up to 3 degrees, is ignored."""
    return math.remainder(math.radians(90 - course), math.tau)


def read_exif(path: Path) -> Fix | None:
    """The position and direction in the EXIF tags of an image; ``None`` without a position. A
    direction from magnetic north is ignored."""
    tag = ExifTags.GPS
    try:
        check_regular(path)
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(tags[tag.GPSLatitude], tags[tag.GPSLatitudeRef])
        longitude = _degrees(tags[tag.GPSLongitude], tags[tag.GPSLongitudeRef])
        is_true = tags.get(tag.GPSImgDirectionRef, "T") == "T"
        course = float(tags.get(tag.GPSImgDirection, "nan")) if is_true else math.nan
        return Fix(latitude, longitude, course)
    except (OSError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


def _degrees(parts: Sequence[float], hemisphere: str) -> float:
    degrees, minutes, seconds = map(float, parts)
    angle = degrees + minutes / 60 + seconds / 3600
    return -angle if hemisphere in ("S", "W") else angle
