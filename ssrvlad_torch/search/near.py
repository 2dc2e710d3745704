"""Near: a place that is roughly known, around which candidates are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..database.frames import numbers_of
from ..datasets.poses import parse_number
from ..evaluation.ground_truth import require_poses


class Near(NamedTuple):
    """A circle on the map of poses: its centre and its radius in metres."""

    x: float
    y: float
    metres: float

    @classmethod
    def of(cls, circle: str | Sequence[float]) -> Near:
        """The circle of three numbers, or of the text ``X,Y,METRES``; a ValueError if they are not
        finite or the radius is negative.

        Examples:
            >>> Near.of("12.5,-3,50")
            Near(x=12.5, y=-3.0, metres=50.0)
        """
        parts = map(parse_number, circle.split(",")) if isinstance(circle, str) else circle
        numbers = numbers_of(parts)
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or numbers[2] < 0:
            raise ValueError(
                "near: expected X,Y,METRES, three finite numbers, the last from 0, such as "
                f"12.5,-3,50, got {circle if isinstance(circle, str) else repr(circle)}"
            )
        return cls(*numbers)

    def __str__(self) -> str:
        return f"within {self.metres:g} m of {self.x:g}, {self.y:g}"

    def rows(self, poses: npt.NDArray[np.float64], path: str) -> npt.NDArray[np.bool_]:
        """``(R,)`` bool, which of the poses ``(R, 3)`` of candidates are inside, NaN where unknown;
        a ValueError if the candidates, of the map at ``path``, have no poses, or none inside."""
        metres = np.hypot(poses[:, 0] - self.x, poses[:, 1] - self.y)
        if np.isnan(metres).all():
            raise ValueError(f"near: expected candidates with poses, {path} has none")
        inside: npt.NDArray[np.bool_] = metres <= self.metres
        if not inside.any():
            nearest = f"the nearest is {np.nanmin(metres):.1f} m away"
            raise ValueError(f"near: no candidate of {path} is {self}; {nearest}")
        return inside


class Posed(NamedTuple):
    """All candidates of known position, and of known heading if that counts."""

    by_heading: bool

    def __str__(self) -> str:
        return "of known pose"

    def rows(self, poses: npt.NDArray[np.float64], path: str) -> npt.NDArray[np.bool_]:
        """As `Near.rows`."""
        return require_poses(f"references of {path}", poses, self.by_heading)
