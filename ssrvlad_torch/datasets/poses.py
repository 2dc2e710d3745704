"""Poses of frames, and ``poses.csv``: ``frame,x,y,heading`` in metres and radians."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..files import absolute_folder, replacing
from .gps import Fix, eastings_northings, heading_of_course

FILE_NAME = "poses.csv"


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

    The columns ``frame``, ``x`` and ``y`` are needed, ``heading`` may be left out; or ``frame``,
    ``latitude`` and ``longitude`` in degrees, with ``course`` in degrees from north to the east or
    without.

    Raises:
        ValueError: the file is no such table, a column is missing or a value is no number; the
            message names the file, and the line.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file, restval="", skipinitialspace=True)
        try:
            columns = set(rows.fieldnames or ())
            if {"frame", "latitude", "longitude"} <= columns:
                fixes = {row["frame"]: _fix(row) for row in rows}
                return dict(zip(fixes, poses_of_fixes([*fixes.values()]), strict=True))
            missing = {"frame", "x", "y"} - columns
            if missing:
                raise ValueError(f"no column {min(missing)!r}; expected frame,x,y,heading")
            return {row["frame"]: _pose(row) for row in rows}
        except (csv.Error, ValueError) as error:
            raise ValueError(f"{path} line {rows.line_num}: {error}") from error


def write_poses(path: Path, poses: Mapping[str, Pose]) -> None:
    """Writes ``frame,x,y,heading``, as `read_poses` reads it.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("frame", *Pose._fields))
        rows.writerows((frame, *pose) for frame, pose in poses.items())


def poses_of_fixes(fixes: Sequence[Fix]) -> list[Pose]:
    """Poses of one drive in metres; see `eastings_northings` for what is raised."""
    places = zip(eastings_northings(fixes), fixes, strict=True)
    return [Pose(*place, heading_of_course(fix.course)) for place, fix in places]


def _fix(row: dict[str, str]) -> Fix:
    course = float(row.get("course") or "nan")
    return Fix(float(row["latitude"]), float(row["longitude"]), course)


def _pose(row: dict[str, str]) -> Pose:
    return Pose(float(row["x"]), float(row["y"]), float(row.get("heading") or "nan"))
