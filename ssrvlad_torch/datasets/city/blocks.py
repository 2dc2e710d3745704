"""The bodies of the city, convex and of eight corners, labelled with Cityscapes ids, and the blocks
that they make: paving, lots, buildings, furniture and trees, and what changes: traffic."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..poses import Pose
from .streets import FAR, PITCH, Conditions, generator, street

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
    """A trunk and a crown of irregular balls, or of bare branches, thin pyramids."""
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


KERB_STRIP = 2.2  # parking bays, grass or paving between kerb and sidewalk
LOT_DEPTH = 18.0  # from the sidewalk to the back of the buildings


class _Style(NamedTuple):
    """Style of the buildings on a side of a block. Spans and the margin are in metres."""

    widths: Span
    heights: Span
    setbacks: Span
    margin: float  # free space on either side of a building
    open: float  # probability of a lot without a building
    pitched: float  # probability of a pitched roof
    barrier: int  # label between the sidewalk and an open lot
    yard: int  # label


_STYLES = (
    _Style((9, 17), (9, 19), (0, 0), 0.0, 0.1, 0.3, WALL, SIDEWALK),  # terrace
    _Style((10, 16), (4, 7), (2, 7), 1.5, 0.25, 0.9, FENCE, TERRAIN),  # villas
    _Style((16, 16), (11, 11), (5, 5), 2.0, 0.0, 0.0, FENCE, TERRAIN),  # estate: all alike
    _Style((16, 26), (5, 10), (5.5, 7), 1.0, 0.3, 0.1, WALL, PARKING),  # works
    _Style((12, 24), (4, 6), (6, 7), 4.0, 0.8, 0.5, FENCE, TERRAIN),  # park
)
_ESTATE = 2


class Side(NamedTuple):
    """A side of a block; its axis runs along the kerb, with the block on the left."""

    axis: Axis
    length: float
    style: _Style
    kerb: int  # label of the kerb strip
    walk: float  # from the kerb to the inner edge of the sidewalk, metres
    key: tuple[int, int, int]  # block and side number, for random generators


def fixed_bodies(seed: int, sides: list[Side], season: str) -> Iterator[Body]:
    """The bodies of a block that are the same on every drive."""
    cut = [(*side.axis.point(s, 0), 0.0) for side in sides for s in (3.0, side.length - 3.0)]
    yield SIDEWALK, cut
    south, east, north, west = sides
    inside = TERRAIN if south.style.yard == TERRAIN else GROUND
    across = (west.walk, south.length - east.walk)
    yield box(south.axis, inside, across, (south.walk, east.length - north.walk))
    for side, following in zip(sides, sides[1:] + sides[:1], strict=True):
        yield box(side.axis, side.kerb, (7, side.length - 7), (0, KERB_STRIP))
        chance, begin, end = generator(seed, "rail", *side.key).random(3)
        if chance < 0.4 and side.kerb != PARKING:
            rail = (6 + 8 * begin, side.length - 6 - 8 * end)
            yield from fence(side.axis, GUARD_RAIL, rail, 0.3, (0.35, 0.85))
        yield from _lots(seed, side, following.walk + LOT_DEPTH, season)
        yield from _furniture(seed, side, season)


def block_sides(seed: int, column: int, row: int, estates: Collection[int] = ()) -> list[Side]:
    """South, east, north and west side; on a street in `estates` those of all blocks are equal."""
    west, east = (street(seed, 0, k) for k in (column, column + 1))
    south, north = (street(seed, 1, k) for k in (row, row + 1))
    x0, x1 = west.position + west.width / 2, east.position - east.width / 2
    y0, y1 = south.position + south.width / 2, north.position - north.width / 2
    axes = (Axis(x0, y0, 1, 0), Axis(x1, y0, 0, 1), Axis(x1, y1, -1, 0), Axis(x0, y1, 0, -1))
    sides = []
    for number, axis in enumerate(axes):
        alike = {0: row, 2: row + 1}.get(number) in estates
        key = (0 if alike else column, row, number)
        rng = generator(seed, "side", *key)
        style = _STYLES[rng.choice(len(_STYLES), p=(0.3, 0.25, 0.2, 0.15, 0.1))]
        style = _STYLES[_ESTATE] if alike else style
        kerb = int(rng.choice((PARKING, TERRAIN, SIDEWALK), p=(0.4, 0.3, 0.3)))
        length = (x1 - x0, y1 - y0)[number % 2]
        walk = KERB_STRIP + rng.uniform(1.5, 3.5)
        sides.append(Side(axis, length, style, kerb, walk, key))
    return sides


def _lots(seed: int, side: Side, corner: float, season: str) -> Iterator[Body]:
    """Lots in a row, built-up or open, with trees; the last `corner` metres stay free."""
    style = side.style
    s = side.walk
    for number in itertools.count():
        rng = generator(seed, "lot", *side.key, number)
        width = rng.uniform(*style.widths)
        if s + width > side.length - corner:
            return
        lot = side.axis.at(s, side.walk)
        if rng.random() < style.open:
            yield box(lot, style.yard, (0, width), (0, LOT_DEPTH))
            label = VEGETATION if rng.random() < 0.3 else style.barrier
            yield from fence(lot, label, (0, width), 0.1, (0, rng.uniform(0.9, 2.0)))
            for along, behind in rng.uniform((0, 3), (width, LOT_DEPTH), (3, 2)).tolist():
                yield from tree(lot.at(along, behind), rng, season)
        else:
            yield from _built_lot(lot, width, style, rng)
        s += width


def _built_lot(lot: Axis, width: float, style: _Style, rng: np.random.Generator) -> Iterator[Body]:
    """A yard and a building with a pitched roof, a smaller top floor, or a flat roof."""
    setback, height = rng.uniform(*style.setbacks), rng.uniform(*style.heights)
    depth = min(12.0, LOT_DEPTH - setback)
    s, d = (style.margin, width - style.margin), (setback, setback + depth)
    yield box(lot, style.yard, (0, width), (0, setback + 0.5))
    if style.barrier == FENCE:
        yield from fence(lot, FENCE, (0, width), 0.1, (0, 1.0))
    yield box(lot, BUILDING, s, d, (0, height))
    roof, along, rise = rng.random(3)
    if roof < style.pitched:
        ridge = (0, depth / 2) if along < 0.6 else ((s[1] - s[0]) / 2, 0)
        yield box(lot, BUILDING, s, d, (height, height + 2.5 + 2 * rise), ridge)
    elif style.heights[0] < style.heights[1] and along < 0.5:
        left, right = np.sort(rng.uniform(*s, 2)).tolist()
        yield box(lot, BUILDING, (left, right), d, (height, height + 2.5 + 3 * rise))


def _furniture(seed: int, side: Side, season: str) -> Iterator[Body]:
    """Lamps, signs, a traffic light or a pole group at the side's start, and a row of trees."""
    rng = generator(seed, "lamps", *side.key)
    step, height, start = rng.uniform((20, 5, 4), (34, 9, 16)).tolist()
    for s in np.arange(start, side.length - 3, step).tolist():
        yield from lamp(side.axis.at(s, 0.6), height)
    rng = generator(seed, "signs", *side.key)
    for s, width in rng.uniform((5, 0.5), (side.length - 4, 1.2), (4, 2)).tolist():
        if rng.random() < 0.5:
            yield from sign(side.axis.at(s, 0.8), width)
    column, row, number = side.key
    junction = column + (number in (1, 2)), row + (number in (2, 3))
    if generator(seed, "junction", *junction).random() < 0.6:
        yield from traffic_light(side.axis.at(3.6, 0.5))
    elif rng.random() < 0.5:
        yield box(side.axis, POLE_GROUP, (3.4, 3.9), (0.5, 0.7), (0, 3.5))
    rng = generator(seed, "trees", *side.key)
    step, avenue = rng.uniform(6, 12), rng.random() < 0.75
    if side.kerb == TERRAIN and avenue:
        for s in np.arange(8, side.length - 7, step).tolist():
            if rng.random() < 0.8:
                yield from tree(side.axis.at(s, 1.3), rng, season)


def changing_bodies(seed: int, side: Side, conditions: Conditions) -> Iterator[Body]:
    """Parked cars, people on the sidewalk and riders at the kerb."""

    def scatter(kind: str, step: float, probability: float) -> Iterator[tuple[Axis, float]]:
        """Random axes on the kerb line, each with a random number in 0..1."""
        rng = generator(conditions.seed, kind, seed, *side.key)
        for s in np.arange(8, side.length - 8, step).tolist():
            chance, shift, number = rng.random(3)
            if chance < min(0.95, probability * conditions.traffic):
                yield side.axis.at(s + 0.7 * shift, 0), number

    if side.kerb == PARKING:
        for axis, number in scatter("bays", step=5.8, probability=0.55):
            yield from car(axis.at(0, 1.15), length=3.9 + number)
    if side.style.yard == PARKING:
        for axis, number in scatter("yards", step=3.0, probability=0.5):
            yield from car(axis.at(0, side.walk + 2.6).left(), length=3.9 + number)
    for axis, number in scatter("people", step=3.0, probability=0.15):
        yield from person(axis.at(0, KERB_STRIP + number * (side.walk - KERB_STRIP)))
    for axis, number in scatter("riders", step=8.0, probability=0.08):
        yield from rider(axis.at(0, -0.5 - 0.4 * number))


def vehicles(seed: int, conditions: Conditions, pose: Pose, seconds: float) -> Iterator[Body]:
    """Cars, trucks and buses that drive on the right of the nearby streets, none at the camera."""
    nearest = round(pose.x / PITCH), round(pose.y / PITCH)
    for axis, step, forward in itertools.product((0, 1), (-1, 0, 1), (1, -1)):
        index = nearest[axis] + step
        position, width = street(seed, axis, index)
        offset = forward * width / 4
        if axis == 0:
            lane = Axis(position + offset, 0, 0, forward)
        else:
            lane = Axis(0, position - offset, forward, 0)
        rng = generator(conditions.seed, "lane", seed, axis, index, forward)
        for vehicle, length in _lane(lane, conditions.traffic, pose, seconds, rng):
            if math.dist((vehicle.x, vehicle.y), (pose.x, pose.y)) <= 4 + length / 2:
                continue
            if length < 5:
                yield from car(vehicle, length)
            else:
                label, height = (BUS, 3.1) if length > 10 else (TRUCK, 3.4)
                span = (-length / 2, length / 2)
                yield box(vehicle, label, span, (-1.25, 1.25), (0.3, height), (0.1, 0.05))


def _lane(
    lane: Axis, traffic: float, pose: Pose, seconds: float, rng: np.random.Generator
) -> Iterator[tuple[Axis, float]]:
    """Axes and lengths of the vehicles on a lane: an endless repetition of 16 random slots."""
    slot, slots = 22.0, 16
    moved = rng.uniform(6, 12) * seconds
    camera = (pose.x - lane.x) * lane.tx + (pose.y - lane.y) * lane.ty
    pattern = rng.random((slots, 3))
    first = math.ceil((camera - FAR - moved) / slot)
    for number in range(first, first + int(2 * FAR / slot)):
        chance, shift, kind = pattern[number % slots].tolist()
        if chance < 0.25 * traffic:
            length = 7.5 if kind < 0.1 else 11.0 if kind < 0.18 else 4 + 0.6 * kind
            yield lane.at((number + 0.4 * shift) * slot + moved, 0), length
