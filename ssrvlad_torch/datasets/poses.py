"""Poses of frames from ``poses.csv``: ``frame,x,y,heading`` in metres and radians."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

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
    for place in (folder, folder.parent):
        if (place / FILE_NAME).is_file():
            return read_poses(place / FILE_NAME)
    return {}


def read_poses(path: Path) -> dict[str, Pose]:
    """Poses by frame, which is a frame's id ``<sequence>/<name>`` or its name alone.

    The columns ``frame``, ``x`` and ``y`` are wanted, ``heading`` may be left out.

    Raises:
        ValueError: a column is missing or a value is no number; the message names the line.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        missing = {"frame", "x", "y"} - set(rows.fieldnames or ())
        if missing:
            raise ValueError(f"{path} has no column {min(missing)!r}; wanted frame,x,y,heading")
        poses = {}
        for row in rows:
            try:
                heading = float(row.get("heading") or "nan")
                poses[row["frame"]] = Pose(float(row["x"]), float(row["y"]), heading)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path} line {rows.line_num}: {error}") from error
    return poses
