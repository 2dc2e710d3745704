"""Poses of frames, and ``poses.csv``: ``frame,x,y,heading`` in metres and radians."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..files import read_text, replacing
from .gps import Fix, eastings_northings, heading_of_course

FILE_NAME = "poses.csv"


class Pose(NamedTuple):
    """Pose of a camera on the ground plane: metres, and radians counter-clockwise from +x."""

    x: float
    y: float
    heading: float


UNKNOWN = Pose(float("nan"), float("nan"), float("nan"))


def parse_number(text: str) -> float:
    """The number that a text is, also ``nan`` and ``inf``. Unlike `float`, it refuses ``1_000`` and
    digits of other scripts; both are a ValueError."""
    if "_" in text or not text.isascii():
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def read_poses(path: Path) -> dict[str, Pose]:
    """Poses by frame, an id ``<sequence>/<name>`` or only a name, of the columns ``frame``, ``x``,
    ``y`` and optionally ``heading``; or ``frame``, ``latitude`` and ``longitude`` in degrees and
    optionally ``course``, in degrees clockwise from north. A missing column, more cells than
    columns, a value that is no number, and one NaN of two coordinates are a ValueError that names
    file and line."""
    rows = csv.DictReader(io.StringIO(read_text(path)), restval="", skipinitialspace=True)
    positions: dict[str, tuple[float, ...]] = {}
    try:
        columns = rows.fieldnames or ()
        if repeated := next((column for column in columns if columns.count(column) > 1), ""):
            raise ValueError(f"two columns {repeated!r}")
        is_gps = {"frame", "latitude", "longitude"} <= set(columns)
        names = Fix._fields if is_gps else Pose._fields  # the last may be empty, which is NaN
        missing = {"frame", "x", "y"} - set(columns)
        if missing and not is_gps:
            raise ValueError(f"no column {min(missing)!r}; expected frame,x,y,heading")
        for row in rows:
            if any(more := row.get(None, ())):  # as by decimal commas, not by one at the end
                raise ValueError(f"more cells than columns: {','.join(more)}")
            numbers = []
            for column in names:
                text = row.get(column) or ""
                is_missing = not text and column == names[-1]
                numbers.append(math.nan if is_missing else parse_number(text))
                if math.isinf(numbers[-1]):
                    raise ValueError(f"{column} is {text}; expected a finite number")
            if math.isnan(numbers[0]) != math.isnan(numbers[1]):
                x, y = (f"{column} is {row[column]}" for column in names[:2])
                raise ValueError(f"{x} and {y}; expected two numbers, or nan twice")
            position = tuple(numbers)
            earlier = positions.setdefault(row["frame"], position)
            if repr(earlier) != repr(position):  # as text, NaN equals NaN
                raise ValueError(f"frame {row['frame']!r} has two positions")
        if is_gps:
            fixes = [Fix(*position) for position in positions.values()]
            return dict(zip(positions, poses_of_fixes(fixes), strict=True))
        return {frame: Pose(*position) for frame, position in positions.items()}
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{path} line {rows.line_num}: {error}") from error


def write_poses(path: Path, poses: Mapping[str, Pose]) -> None:
    """Writes a table ``frame,x,y,heading`` that `read_poses` reads."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("frame", *Pose._fields))
        rows.writerows((frame, *pose) for frame, pose in poses.items())


def poses_of_fixes(fixes: Sequence[Fix]) -> list[Pose]:
    """Poses of one drive; errors as for `eastings_northings`."""
    positions = zip(eastings_northings(fixes), fixes, strict=True)
    return [Pose(*position, heading_of_course(fix.course)) for position, fix in positions]
