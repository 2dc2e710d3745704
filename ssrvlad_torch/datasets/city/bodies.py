"""The bodies of the city: convex, of eight corners, labelled with Cityscapes ids."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

GROUND, ROAD, SIDEWALK, PARKING, BUILDING, WALL, FENCE, GUARD_RAIL = 6, 7, 8, 9, 11, 12, 13, 14
POLE, POLE_GROUP, TRAFFIC_LIGHT, TRAFFIC_SIGN, VEGETATION, TERRAIN, SKY = 17, 18, 19, 20, 21, 22, 23
PERSON, RIDER, CAR, TRUCK, BUS, BICYCLE = 24, 25, 26, 27, 28, 33


class Axis(NamedTuple):
    """A directed line on the map from (x, y) in the unit direction (tx, ty)."""

    x: float
    y: float
    tx: float
    ty: float

    def point(self, s: float, d: float) -> tuple[float, float]:
        """Map coordinates of (s, d)."""
        return self.x + s * self.tx - d * self.ty, self.y + s * self.ty + d * self.tx

    def at(self, s: float, d: float) -> Axis:
        """The parallel axis that starts at (s, d)."""
        return Axis(*self.point(s, d), self.tx, self.ty)

    def left(self) -> Axis:
        """The axis rotated by 90 degrees to the left about its start."""
        return Axis(self.x, self.y, -self.ty, self.tx)


Span = tuple[float, float]
Corners = list[tuple[float, float, float]]
Body = tuple[int, Corners]  # label id and eight corners


class Bodies(NamedTuple):
    """Label ids (S,) and corners (S, 8, 3) of bodies; flat bodies are in the order of painting."""

    labels: NDArray[np.uint8]
    corners: NDArray[np.float64]


def pack(bodies: Iterable[Body]) -> Bodies:
    """Bodies as arrays."""
    pairs = list(bodies)
    corners = np.array([corners for _, corners in pairs], float).reshape(-1, 8, 3)
    return Bodies(np.array([label for label, _ in pairs], np.uint8), corners)


def box(axis: Axis, label: int, s: Span, d: Span, z: Span = (0, 0), inset: Span = (0, 0)) -> Body:
    """A box over the rectangle `s` x `d`; its top is smaller by `inset` on each side."""
    corners = []
    for height, ds, dd in ((z[0], 0.0, 0.0), (z[1], *inset)):
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
            place = (s[0] + ds, s[1] - ds)[a], (d[0] + dd, d[1] - dd)[b]
            corners.append((*axis.point(*place), height))
    return label, corners


def pole(axis: Axis, height: float, thickness: float = 0.16, label: int = POLE) -> Body:
    """A square post."""
    half = thickness / 2
    return box(axis, label, (-half, half), (-half, half), (0, height))


def lamp(axis: Axis, height: float) -> Iterator[Body]:
    """A street lamp; its arm reaches over the street, to the right of the axis."""
    yield pole(axis, height)
    yield box(axis, POLE, (-0.08, 0.08), (-1.8, 0), (height - 0.15, height))


def sign(axis: Axis, width: float) -> Iterator[Body]:
    """A traffic sign, perpendicular to the street."""
    yield pole(axis, 2.2, 0.1)
    yield box(axis, TRAFFIC_SIGN, (-0.05, 0.05), (-width / 2, width / 2), (2.0, 2.75))


def traffic_light(axis: Axis) -> Iterator[Body]:
    """A traffic light on its pole."""
    yield pole(axis, 2.6)
    yield box(axis, TRAFFIC_LIGHT, (-0.2, 0.2), (-0.2, 0.2), (2.5, 3.5))


def person(axis: Axis, label: int = PERSON, feet: float = 0.0) -> Iterator[Body]:
    """A person; `feet` is the height of the feet."""
    yield box(axis, label, (-0.2, 0.2), (-0.24, 0.24), (feet, feet + 1.45), (0.03, 0.03))
    yield box(axis, label, (-0.1, 0.1), (-0.1, 0.1), (feet + 1.45, feet + 1.75))


def rider(axis: Axis) -> Iterator[Body]:
    """A bicycle and its rider."""
    yield box(axis, BICYCLE, (-0.85, 0.85), (-0.1, 0.1), (0, 1.0), (0.3, 0.0))
    yield from person(axis, RIDER, feet=0.25)


def car(axis: Axis, length: float) -> Iterator[Body]:
    """A car: body and cabin."""
    half = length / 2
    yield box(axis, CAR, (-half, half), (-0.9, 0.9), (0.15, 0.85))
    yield box(axis, CAR, (-half + 0.4, half - 1.0), (-0.85, 0.85), (0.8, 1.48), (0.55, 0.15))


def tree(axis: Axis, rng: np.random.Generator, season: str) -> Iterator[Body]:
    """A tree: a trunk, and a crown of irregular balls or bare branches, thin pyramids from the fork
    outwards; all vegetation, as in Cityscapes."""
    size, girth, evergreen = rng.random(3)
    height, radius = 5 + 6 * size, 1.4 + 1.6 * girth
    fork = 0.35 * height
    is_bare = season == "winter" and evergreen <= 0.85
    yield pole(axis, fork + 0.5, 0.35, VEGETATION)
    for s, d, up, wide, tall in rng.uniform(-0.5, 0.5, (5, 5)).tolist():
        if is_bare:
            tip = (*axis.point(2 * radius * s, 2 * radius * d), height * (0.9 + 0.2 * up))
            foot = [
                (*axis.point(a, b), fork) for a, b in ((-0.1, 0), (0.1, 0), (0, -0.1), (0, 0.1))
            ]
            yield VEGETATION, foot + [tip] * 4
        else:
            middle, z = axis.at(radius * s, radius * d), (fork + height) / 2 + radius * up
            across, along = radius * (0.75 + 0.3 * wide), (height - fork) * (0.4 + 0.15 * tall)
            ball = [(*middle.point(across * a, across * b), z + along * c) for a, b, c in _BALL]
            yield VEGETATION, ball


_BALL = ((1, 0, 0.3), (0.3, 0.9, -0.5), (-0.9, 0.4, 0.4), (-0.6, -0.7, -0.6),
         (0.5, -0.8, 0.4), (0, 0, 1), (0, 0, -1), (0.2, 0.3, -0.9))  # fmt: skip


def fence(axis: Axis, label: int, s: Span, d: float, z: Span) -> Iterator[Body]:
    """A long thin body along the axis, in short pieces that can be sorted by distance."""
    stops = np.linspace(*s, max(2, math.ceil((s[1] - s[0]) / 5) + 1)).tolist()
    for piece in itertools.pairwise(stops):
        yield box(axis, label, piece, (d, d + 0.2), z)
