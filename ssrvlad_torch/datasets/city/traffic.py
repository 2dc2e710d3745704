"""What moves, or was parked: other vehicles and people on every drive."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from ..poses import Pose
from .blocks import KERB_STRIP, Side
from .bodies import BUS, PARKING, TRUCK, Axis, Body, box, car, person, rider
from .conditions import Conditions, generator
from .picture import FAR
from .streets import PITCH, street


def passers_by(seed: int, side: Side, conditions: Conditions) -> Iterator[Body]:
    """Parked cars, people on the sidewalk, riders at the kerb: other ones on every drive."""

    def scatter(kind: str, step: float, chance: float) -> Iterator[tuple[Axis, float]]:
        """Places on the kerb line, each taken with a chance, and a number in 0..1 for each."""
        rng = generator(conditions.seed, kind, seed, *side.key)
        for s in np.arange(8, side.length - 8, step).tolist():
            taken, shift, number = rng.random(3)
            if taken < min(0.95, chance * conditions.traffic):
                yield side.axis.at(s + 0.7 * shift, 0), number

    if side.kerb == PARKING:
        for place, number in scatter("bays", step=5.8, chance=0.55):
            yield from car(place.at(0, 1.15), length=3.9 + number)
    if side.style.yard == PARKING:
        for place, number in scatter("yards", step=3.0, chance=0.5):
            yield from car(place.at(0, side.walk + 2.6).left(), length=3.9 + number)
    for place, number in scatter("people", step=3.0, chance=0.15):
        yield from person(place.at(0, KERB_STRIP + number * (side.walk - KERB_STRIP)))
    for place, number in scatter("riders", step=8.0, chance=0.08):
        yield from rider(place.at(0, -0.5 - 0.4 * number))


def vehicles(seed: int, conditions: Conditions, pose: Pose, seconds: float) -> Iterator[Body]:
    """Vehicles driving on the streets around, on the right, none of them over the camera."""
    nearest = round(pose.x / PITCH), round(pose.y / PITCH)
    for axis, offset, forward in itertools.product((0, 1), (-1, 0, 1), (1, -1)):
        index = nearest[axis] + offset
        driven = street(seed, axis, index)
        aside = forward * driven.width / 4
        if axis == 0:
            lane = Axis(driven.position + aside, 0, 0, forward)
        else:
            lane = Axis(0, driven.position - aside, forward, 0)
        rng = generator(conditions.seed, "lane", seed, axis, index, forward)
        for vehicle, length in _lane(lane, conditions.traffic, pose, seconds, rng):
            if math.dist((vehicle.x, vehicle.y), (pose.x, pose.y)) > 4 + length / 2:
                yield from _vehicle(vehicle, length)


def _lane(
    lane: Axis, traffic: float, pose: Pose, seconds: float, rng: np.random.Generator
) -> Iterator[tuple[Axis, float]]:
    """Places and lengths of the vehicles on a lane: a column of 16 slots that recurs for ever."""
    slot, slots = 22.0, 16
    moved = rng.uniform(6, 12) * seconds
    here = (pose.x - lane.x) * lane.tx + (pose.y - lane.y) * lane.ty
    column = rng.random((slots, 3))
    first = math.ceil((here - FAR - moved) / slot)
    for number in range(first, first + int(2 * FAR / slot)):
        taken, shift, kind = column[number % slots].tolist()
        if taken < 0.25 * traffic:
            length = 7.5 if kind < 0.1 else 11.0 if kind < 0.18 else 4 + 0.6 * kind
            yield lane.at((number + 0.4 * shift) * slot + moved, 0), length


def _vehicle(axis: Axis, length: float) -> Iterator[Body]:
    """A car, a truck (7.5 m) or a bus (11 m)."""
    if length < 5:
        yield from car(axis, length)
    else:
        label, height = (BUS, 3.1) if length > 10 else (TRUCK, 3.4)
        half = length / 2
        yield box(axis, label, (-half, half), (-1.25, 1.25), (0.3, height), (0.1, 0.05))
