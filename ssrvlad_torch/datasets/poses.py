"""Poses of frames, and ``poses.csv``: ``frame,x,y,heading`` in metres and radians."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from ..files import absolute_folder, replacing
from ..untrusted import read_text
from .gps import Fix, eastings_northings, heading_of_course

FILE_NAME = "poses.csv"

Place = TypeVar("Place")


class Pose(NamedTuple):
    """A camera on the ground plane: metres, and radians counter-clockwise from +x."""

    x: float
    y: float
    heading: float


UNKNOWN = Pose(float("nan"), float("nan"), float("nan"))


def find_poses(folder: Path) -> dict[str, Pose]:
    """Poses of a folder of frames, from the ``poses.csv`` in it or beside it, if there is one.

    Raises:
        ValueError: the file is damaged; see `read_poses`.
    """
    for place in (folder, absolute_folder(folder).parent):
        if (place / FILE_NAME).is_file():
            return read_poses(place / FILE_NAME)
    return {}


def read_poses(path: Path) -> dict[str, Pose]:
    """Poses by frame, which is a frame's id ``<sequence>/<name>`` or its name alone.

    The columns are ``frame``, ``x``, ``y`` and optionally ``heading``; or ``frame``, ``latitude``
    and ``longitude`` in degrees and optionally ``course``, in degrees from north to the east.

    Raises:
        ValueError: the file is no such table, or a value is no number; with the file and the line.
    """
    rows = csv.DictReader(io.StringIO(read_text(path)), restval="", skipinitialspace=True)
    try:
        columns = rows.fieldnames or ()
        twice = next((column for column in columns if columns.count(column) > 1), None)
        if twice is not None:
            raise ValueError(f"two columns {twice!r}")
        if {"frame", "latitude", "longitude"} <= set(columns):
            fixes = _by_frame(rows, Fix, "latitude", "longitude", "course")
            return dict(zip(fixes, poses_of_fixes([*fixes.values()]), strict=True))
        missing = {"frame", "x", "y"} - set(columns)
        if missing:
            raise ValueError(f"no column {min(missing)!r}; expected frame,x,y,heading")
        return _by_frame(rows, Pose, *Pose._fields)
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{path} line {rows.line_num}: {error}") from error


def write_poses(path: Path, poses: Mapping[str, Pose]) -> None:
    """Writes ``frame,x,y,heading``, as `read_poses` reads it.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("frame", *Pose._fields))
        rows.writerows((frame, *pose) for frame, pose in poses.items())


def poses_of_fixes(fixes: Sequence[Fix]) -> list[Pose]:
    """Poses of one drive in metres; for errors see `eastings_northings`."""
    places = zip(eastings_northings(fixes), fixes, strict=True)
    return [Pose(*place, heading_of_course(fix.course)) for place, fix in places]


def _by_frame(
    rows: Iterable[dict[str, str]], kind: Callable[..., Place], *columns: str
) -> dict[str, Place]:
    """The place of each frame, which may be there twice if it is the same."""
    places: dict[str, Place] = {}
    for row in rows:
        found = kind(*(_number(row, column) for column in columns))
        earlier = places.setdefault(row["frame"], found)
        if repr(earlier) != repr(found):  # in which NaN is as NaN
            raise ValueError(f"frame {row['frame']!r} is at two places")
    return places


def _number(row: dict[str, str], column: str) -> float:
    """The number in a column; only a direction may be missing."""
    text = row.get(column) or ""
    value = float(text or "nan") if column in ("heading", "course") else float(text)
    if math.isinf(value):
        raise ValueError(f"{column} is {text}; expected a finite number")
    return value
