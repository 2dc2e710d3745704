"""Poses of frames from ``poses.csv``: ``frame,x,y,heading`` in metres and radians."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

from ..files import absolute_folder

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

    The columns ``frame``, ``x`` and ``y`` are needed, ``heading`` may be left out.

    Raises:
        ValueError: the file is no such table, a column is missing or a value is no number; the
            message names the file, and the line.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file, restval="", skipinitialspace=True)
        try:
            missing = {"frame", "x", "y"} - set(rows.fieldnames or ())
            if missing:
                raise ValueError(f"no column {min(missing)!r}; expected frame,x,y,heading")
            return {row["frame"]: _pose(row) for row in rows}
        except (csv.Error, ValueError) as error:
            raise ValueError(f"{path} line {rows.line_num}: {error}") from error


def _pose(row: dict[str, str]) -> Pose:
    return Pose(float(row["x"]), float(row["y"]), float(row.get("heading") or "nan"))
