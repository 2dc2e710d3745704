"""Positions of GPS receivers with their times: GPX and NMEA 0183. Needs the extra ``gps``."""

import math
from collections.abc import Iterator
from datetime import UTC, datetime, time
from itertools import chain, count, pairwise
from pathlib import Path

from ..files import one_line, read_text
from .gps import Fix

SUFFIXES = (".gpx", ".nmea")


def read_track(path: Path) -> list[list[tuple[float, Fix]]]:
    """The positions of a receiver, each with its time in seconds since 1970 UTC: the track points
    of each segment of a GPX file, between which nothing was recorded, or the RMC sentences of an
    NMEA file with a valid position, which have position, course, time and date. A damaged file, a
    point without a time, and times out of order are a ValueError; without the extra ``gps``, an
    ImportError."""
    text = read_text(path)
    try:
        track = _of_gpx(text) if path.suffix.lower() == ".gpx" else [list(_of_nmea(text))]
    except ImportError as error:
        raise ImportError(f"{path} needs: pip install ssrvlad-torch[gps]") from error
    except Exception as error:  # the parsers raise any exception on damaged text
        raise ValueError(f"{path}: {one_line(error)}") from error
    if not any(track):
        expected = "track points" if path.suffix.lower() == ".gpx" else "RMC sentences"
        raise ValueError(f"{path} holds no positions; expected {expected}")
    for number, ((before, _), (after, _)) in enumerate(pairwise(chain(*track)), 2):
        if after < before:
            raise ValueError(f"{path}: position {number} is earlier than the one before it")
    return [segment for segment in track if segment]


def _of_gpx(text: str) -> list[list[tuple[float, Fix]]]:
    import gpxpy

    if "<!" in text.replace("<!--", "").replace("<![CDATA[", ""):
        raise ValueError("expected GPX without a document type")  # its entities can grow
    track, numbers = list[list[tuple[float, Fix]]](), count(1)
    for segment in (segment for track in gpxpy.parse(text).tracks for segment in track.segments):
        track.append([])
        for point in segment.points:
            number = next(numbers)
            if point.time is None:
                raise ValueError(f"point {number} has no time, as 2026-05-01T10:00:00Z")
            course = math.nan if point.course is None else float(point.course)
            fix = Fix(point.latitude, point.longitude, course)
            track[-1].append((_seconds(point.time), fix))
    return track


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
            ways = sentence.lat_dir in ("N", "S") and sentence.lon_dir in ("E", "W")
            if not (ways and sentence.lat and sentence.lon):  # the parser would say 0
                raise ValueError(f"expected a position, got {','.join(position)}")
            if any(float(angle) % 100 > 60 for angle in position[::2]):
                raise ValueError(f"expected at most 60 minutes, got {','.join(position)}")
            if not isinstance(sentence.timestamp, time):  # as in a leap second, 235960
                raise ValueError(f"expected a time of day, got {sentence.timestamp}")
            course = float(sentence.true_course or "nan")
            fix = Fix(sentence.latitude, sentence.longitude, course)
            yield _seconds(sentence.datetime), fix
        except Exception as error:
            raise ValueError(f"line {number}: {one_line(error)}") from error


def _seconds(time: datetime) -> float:
    """Seconds since 1970; a time without a zone is UTC."""
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
