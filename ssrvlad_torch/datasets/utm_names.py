"""File names that hold the position of an image, in the form of VPR-methods-evaluation.

``@ UTM east @ UTM north @ zone number @ zone letter @ latitude @ longitude @ panorama @ tile
@ heading @ pitch @ roll @ height @ time stamp @ note @.jpg``; all but the first two may be empty or
missing. The heading is in degrees clockwise from north.
"""

import math
from datetime import UTC, datetime

from .gps import heading_of_course
from .poses import UNKNOWN, Pose, parse_number

_HEADING, _TIME, _NOTE = 9, 13, 14
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


def write_name(name: str, pose: Pose, stamp: float = math.nan) -> str:
    """A file name that holds the pose, the time if it is known, and ``name`` as its note. An
    unknown position is a ValueError.

    Examples:
        >>> write_name("000007", Pose(303189.3, 5787193.0, 0.0))
        '@0303189.30@5787193.00@@@@@@@90.00@@@@@000007@'
    """
    if math.isnan(pose.x) or math.isnan(pose.y):
        raise ValueError(f"{name} has no known position")
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
