"""Positions on the globe (WGS 84) as metres of UTM. Needs the extra ``gps``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import ExifTags, Image


class Fix(NamedTuple):
    """Degrees of latitude and longitude, and of the course from north to the east or NaN."""

    latitude: float
    longitude: float
    course: float = math.nan


def eastings_northings(fixes: Sequence[Fix]) -> list[tuple[float, float]]:
    """Metres to the east and to the north of one drive.

    Raises:
        ValueError: a position is outside UTM, or the drive crosses the border of a zone.
        ImportError: the extra ``gps`` is not installed.
    """
    try:
        import utm
    except ImportError as error:
        raise ImportError("latitudes need: pip install ssrvlad-torch[gps]") from error
    found = [utm.from_latlon(fix.latitude, fix.longitude) for fix in fixes]
    if len({(zone, letter < "N") for _, _, zone, letter in found}) > 1:
        raise ValueError("the drive crosses the border of a UTM zone; expected x and y in metres")
    return [(float(east), float(north)) for east, north, _, _ in found]


def heading_of_course(course: float) -> float:
    """Radians from +x (east) to +y (north) of a course; the up to 3 degrees between the norths of
    the map and of the globe are not taken off."""
    return math.remainder(math.radians(90 - course), math.tau)


def read_exif(picture: Path) -> Fix | None:
    """The position and direction in the EXIF tags of a picture; ``None`` without a position. A
    direction from magnetic north is left out."""
    tag = ExifTags.GPS
    try:
        with Image.open(picture) as opened:
            tags = opened.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(tags[tag.GPSLatitude], tags[tag.GPSLatitudeRef])
        longitude = _degrees(tags[tag.GPSLongitude], tags[tag.GPSLongitudeRef])
        true = tags.get(tag.GPSImgDirectionRef, "T") == "T"
        return Fix(
            latitude, longitude, float(tags.get(tag.GPSImgDirection, "nan") if true else "nan")
        )
    except (OSError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


def _degrees(parts: Sequence[float], hemisphere: str) -> float:
    degrees, minutes, seconds = map(float, parts)
    whole = degrees + minutes / 60 + seconds / 3600
    return -whole if hemisphere in ("S", "W") else whole
