"""Positions of GPS receivers with their times: GPX and NMEA 0183. Needs the extra ``gps``."""

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

from ..files import one_line, read_text
from .gps import Fix

SUFFIXES = (".gpx", ".nmea")


def read_track(path: Path) -> list[tuple[float, Fix]]:
    """The positions of a receiver, each with its time in seconds since 1970 UTC: all track points
    of a GPX file, or the RMC sentences of an NMEA file with a valid position, which have position,
    course, time and date. A damaged file, a point without a time, and times out of order are a
    ValueError; without the extra ``gps``, an ImportError."""
    text = read_text(path)
    try:
        track = list((_of_gpx if path.suffix.lower() == ".gpx" else _of_nmea)(text))
    except ImportError as error:
        raise ImportError(f"{path} needs: pip install ssrvlad-torch[gps]") from error
    except Exception as error:  # the parsers raise any exception on damaged text
        raise ValueError(f"{path}: {one_line(error)}") from error
    if not track:
        expected = "track points" if path.suffix.lower() == ".gpx" else "RMC sentences"
        raise ValueError(f"{path} holds no positions; expected {expected}")
    for number, ((before, _), (after, _)) in enumerate(pairwise(track), 2):
        if after < before:
            raise ValueError(f"{path}: position {number} is earlier than the one before it")
    return track


def _of_gpx(text: str) -> Iterator[tuple[float, Fix]]:
    import gpxpy

    if "<!" in text.replace("<!--", "").replace("<![CDATA[", ""):
        raise ValueError("expected GPX without a document type")  # its entities can grow
    points = gpxpy.parse(text).walk(only_points=True)
    for number, point in enumerate(points, 1):
        if point.time is None:
            raise ValueError(f"point {number} has no time")
        course = math.nan if point.course is None else float(point.course)
        yield _seconds(point.time), Fix(point.latitude, point.longitude, course)


def _of_nmea(text: str) -> Iterator[tuple[float, Fix]]:
    import pynmea2

    for number, line in enumerate(text.splitlines(), 1):
        if line[3:6] != "RMC":
            continue
        try:
            sentence = pynmea2.parse(line, check=True)
            if sentence.status != "A":
                continue
            position = sentence.lat, sentence.lat_dir, sentence.lon, sentence.lon_dir
            if not all(position):  # the parser would say 0
                raise ValueError(f"expected a position, got {','.join(position)}")
            course = float(sentence.true_course or "nan")
            fix = Fix(sentence.latitude, sentence.longitude, course)
            yield _seconds(sentence.datetime), fix
        except Exception as error:
            raise ValueError(f"line {number}: {one_line(error)}") from error


def _seconds(time: datetime) -> float:
    """Seconds since 1970; a time without a zone is UTC."""
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
