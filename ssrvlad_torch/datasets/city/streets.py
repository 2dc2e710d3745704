"""The infinite grid of streets, the route through it, and camera poses and conditions on it."""

import itertools
import math
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..poses import Pose


@dataclass(frozen=True)
class Conditions:
    """Conditions of a drive.

    Args:
        spacing: metres between frames, along the centre line of the street (> 0).
        lateral_offset: metres to the left of the usual lane; about +-1.5 stay in the lane.
        heading_offset: rotation of the camera to the left in degrees.
        heading_jitter: standard deviation in degrees of a smooth rotation of the camera.
        traffic: amount of vehicles and people; 0 none, 1 usual, 3 heavy.
        season: "summer", or "winter", when most trees are bare.
        noise: strength of the errors of a segmentation network, see `segmentation_noise`; 0 none.
        seed: of all that differs between drives, >= 0.
    """

    spacing: float = 3.0
    lateral_offset: float = 0.0
    heading_offset: float = 0.0
    heading_jitter: float = 0.0
    traffic: float = 1.0
    season: str = "summer"
    noise: float = 0.0
    seed: int = 0


def generator(seed: int, name: str, *key: int) -> np.random.Generator:
    """An independent random generator for each seed, name and key; the key may be negative."""
    name_hash = zlib.crc32(name.encode())
    return np.random.default_rng([seed, name_hash, *(number % 2**32 for number in key)])


FAR = 120.0  # nothing farther is drawn, metres
PITCH = 80.0  # mean distance of neighbouring streets, metres
PITCH_JITTER = 16.0
TURN_RADIUS = 8.0
LANE = 2.0  # the camera drives this far right of the street's centre line
_DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))


class Street(NamedTuple):
    """Width of a street, and x (axis 0, runs north) or y (axis 1, runs east) of its middle."""

    position: float
    width: float


def street(seed: int, axis: int, index: int) -> Street:
    """A street by its number."""
    shift, width = generator(seed, "street", axis, index).random(2).tolist()
    return Street(index * PITCH + PITCH_JITTER * (2 * shift - 1), 8.0 + 5.0 * width)


def nearby_blocks(pose: Pose) -> Iterator[tuple[int, int]]:
    """Columns and rows of all blocks within `FAR` of the pose, and of a few more."""
    column, row = math.floor(pose.x / PITCH), math.floor(pose.y / PITCH)
    return itertools.product(range(column - 2, column + 3), range(row - 2, row + 3))


class _Piece(NamedTuple):
    """A piece of the route: start pose, length in metres, curvature to the left in 1/m."""

    x: float
    y: float
    heading: float
    length: float
    curvature: float

    def at(self, metres: float) -> Pose:
        """The pose after some metres."""
        heading = self.heading + self.curvature * metres
        if self.curvature == 0:
            x, y = metres * math.cos(heading), metres * math.sin(heading)
        else:
            x = (math.sin(heading) - math.sin(self.heading)) / self.curvature
            y = (math.cos(self.heading) - math.cos(heading)) / self.curvature
        return Pose(self.x + x, self.y + y, heading)


def _random_turns(seed: int) -> Iterator[int]:
    """The turns of the endless default route: north, east and south, never west."""
    rng = generator(seed, "route")
    heading = 0  # quarter turns, -1 south, 0 east, 1 north
    while True:
        turn = int(rng.choice((-1, 0, 0, 1) if heading == 0 else (0, -heading)))
        yield turn
        heading += turn


def _route(seed: int, turns: Iterable[int]) -> Iterator[_Piece]:
    """The centre line of the route, with rounded turns at the junctions."""
    node, heading = (0, 0), 0  # heading: quarter turns to the left of east
    x, y = street(seed, 0, 0).position + TURN_RADIUS, street(seed, 1, 0).position
    for turn in turns:
        east, north = _DIRECTIONS[heading % 4]
        node = (node[0] + east, node[1] + north)
        junction = (street(seed, 0, node[0]).position, street(seed, 1, node[1]).position)
        straight = math.dist((x, y), junction) - TURN_RADIUS
        arc = TURN_RADIUS * (math.pi / 2 if turn else 2)
        approach = _Piece(x, y, heading * math.pi / 2, straight, 0.0)
        crossing = _Piece(*approach.at(straight), arc, turn / TURN_RADIUS)
        yield from (approach, crossing)
        x, y, _ = crossing.at(arc)
        heading += turn


def camera_poses(
    seed: int, conditions: Conditions, turns: Iterable[int] | None = None
) -> Iterator[Pose]:
    """Camera poses, `conditions.spacing` metres apart along the route, until it ends."""
    phases = generator(conditions.seed, "sway", seed).uniform(0, math.tau, 2).tolist()
    left = conditions.lateral_offset - LANE
    travelled, begin = 0.0, 0.0
    for piece in _route(seed, _random_turns(seed) if turns is None else turns):
        while travelled < begin + piece.length:
            x, y, course = piece.at(travelled - begin)
            sway = math.sin(travelled / 17 + phases[0]) + math.sin(travelled / 5 + phases[1])
            turned = conditions.heading_offset + conditions.heading_jitter * sway
            heading = math.remainder(course + math.radians(turned), math.tau)
            yield Pose(x - left * math.sin(course), y + left * math.cos(course), heading)
            travelled += conditions.spacing
        begin += piece.length
