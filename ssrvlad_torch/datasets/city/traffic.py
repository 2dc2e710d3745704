"""Vehicles and people, which differ between drives."""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from ..poses import Pose
from .blocks import KERB_STRIP, Side
from .bodies import BUS, PARKING, TRUCK, Axis, Body, box, car, person, rider
from .conditions import Conditions, generator
from .rendering import FAR
from .streets import PITCH, street


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
    """Cars, trucks (7.5 m) and buses (11 m) that drive on the right of the nearby streets, none of
    them at the camera."""
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
