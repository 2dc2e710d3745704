"""A small deterministic city: label maps of a drive through it, once and once again.

The city is an endless grid of streets at irregular distances. Between the streets lie blocks; each
side of a block has its own style of building, kerb, trees, lamps and signs, drawn from a random
generator of its own, so any part of the city can be made without making the rest. The route goes
east, north or south and never back: it crosses itself nowhere, and a longer drive begins like a
shorter one.

Everything that stands is a convex body of eight corners, and its picture is the convex hull of the
corners' pictures; ground patches are bodies without height. A frame is painted far to near.

Map coordinates are metres: x east, y north, z up. Angles are counter-clockwise from east.
Streets, kerbs and walls are described in (s, d): metres along an axis, and to its left.
"""

from __future__ import annotations

import functools
import io
import itertools
import json
import math
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ssrvlad_torch.datasets.poses import Pose
from ssrvlad_torch.datasets.segmentation_noise import SegmentationNoise
from ssrvlad_torch.taxonomy import palette

GROUND, ROAD, SIDEWALK, PARKING, BUILDING, WALL, FENCE, GUARD_RAIL = 6, 7, 8, 9, 11, 12, 13, 14
POLE, POLE_GROUP, TRAFFIC_LIGHT, TRAFFIC_SIGN, VEGETATION, TERRAIN, SKY = 17, 18, 19, 20, 21, 22, 23
PERSON, RIDER, CAR, TRUCK, BUS, BICYCLE = 24, 25, 26, 27, 28, 33
TRAIN_IDS = {
    ROAD: 0, SIDEWALK: 1, BUILDING: 2, WALL: 3, FENCE: 4, POLE: 5, TRAFFIC_LIGHT: 6,
    TRAFFIC_SIGN: 7, VEGETATION: 8, TERRAIN: 9, SKY: 10, PERSON: 11, RIDER: 12, CAR: 13,
    TRUCK: 14, BUS: 15, BICYCLE: 18,
}  # fmt: skip
LABEL_SPACES = ("cityscapes-trainids", "cityscapes-ids")
SEASONS = ("summer", "winter")

PITCH = 80.0  # mean distance of neighbouring streets
PITCH_JITTER = 16.0
TURN_RADIUS = 8.0
LANE = 2.0  # the camera drives this far right of the street's centre line
FRAME_SECONDS = 1 / 3
KERB_STRIP = 2.2  # parking bays, grass or paving between kerb and sidewalk
LOT_DEPTH = 18.0  # from the sidewalk to the back of the buildings

CAMERA_HEIGHT = 1.5
FIELD_OF_VIEW = math.radians(85)
NEAR, FAR = 0.3, 120.0
SMALLEST_PIXELS = 0.35  # thinner things are not painted
MINIMUM_SIZE = 16


def _generator(seed: int, thing: str, *key: int) -> np.random.Generator:
    """Random generator of one thing, independent of all others; the key may be negative."""
    name = zlib.crc32(thing.encode())
    return np.random.default_rng([seed, name, *(number % 2**32 for number in key)])


def _require(holds: bool, name: str, got: object, wanted: str) -> None:
    if not holds:
        raise ValueError(f"{name}: got {got!r}, wanted {wanted}")


# ---------------------------------------------------------------------------- public


class Frame(NamedTuple):
    """One picture of a traverse: (H, W) uint8 label ids, the camera's pose, and ``"000000"``..."""

    labels: NDArray[np.uint8]
    pose: Pose
    name: str


@dataclass(frozen=True)
class Conditions:
    """How and when the streets are driven.

    Args:
        spacing: metres driven between frames, along the street's centre line (> 0).
        lateral_offset: metres to the left of the usual lane; the lane has room for about +-1.5.
        heading_offset: degrees by which the camera is turned to the left.
        heading_jitter: standard deviation in degrees of a smooth swaying of the camera.
        traffic: amount of vehicles and people; 0 none, 1 usual, 3 heavy.
        season: "summer", or "winter" when most trees are bare.
        noise: mistakes of a segmentation network, or None for perfect labels.
        seed: of everything that differs from drive to drive (>= 0).
    """

    spacing: float = 3.0
    lateral_offset: float = 0.0
    heading_offset: float = 0.0
    heading_jitter: float = 0.0
    traffic: float = 1.0
    season: str = "summer"
    noise: SegmentationNoise | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("spacing", "lateral_offset", "heading_offset", "heading_jitter", "traffic"):
            _require(math.isfinite(getattr(self, name)), name, getattr(self, name), "finite")
        _require(self.spacing > 0, "spacing", self.spacing, "metres > 0")
        _require(self.heading_jitter >= 0, "heading_jitter", self.heading_jitter, "degrees >= 0")
        _require(self.traffic >= 0, "traffic", self.traffic, "a number >= 0")
        _require(self.season in SEASONS, "season", self.season, f"one of {SEASONS}")
        _require(self.seed >= 0, "seed", self.seed, "an integer >= 0")


REFERENCE = Conditions()
QUERY = Conditions(
    spacing=2.7,
    lateral_offset=0.7,
    heading_jitter=2.0,
    season="winter",
    noise=SegmentationNoise(),
    seed=1,
)


@dataclass(frozen=True)
class SyntheticCity:
    """A city and a route through it; equal seeds (>= 0) give equal frames.

    Example:
        >>> frame = next(SyntheticCity(seed=0).traverse(frames=1))
        >>> frame.labels.shape, frame.name
        ((240, 320), '000000')
    """

    seed: int = 0

    def __post_init__(self) -> None:
        _require(self.seed >= 0, "seed", self.seed, "an integer >= 0")

    def traverse(
        self,
        frames: int,
        conditions: Conditions = REFERENCE,
        size: tuple[int, int] = (240, 320),
        labels_as: str = "cityscapes-trainids",
    ) -> Iterator[Frame]:
        """Drive the route and label what the camera sees, lazily.

        A frame depends on its number, not on how many are asked for.

        Args:
            frames: number of frames (>= 1); the route has no end.
            conditions: how the streets are driven.
            size: height and width in pixels, each >= 16. The view is 85 degrees wide.
            labels_as: "cityscapes-trainids", where 255 is every class without a train id (guard
                rail, parking, ground, pole group), or "cityscapes-ids".
        """
        _require(frames >= 1, "frames", frames, "at least 1")
        _require(min(size) >= MINIMUM_SIZE, "size", size, f"at least {MINIMUM_SIZE} pixels a side")
        _require(labels_as in LABEL_SPACES, "labels_as", labels_as, f"one of {LABEL_SPACES}")
        return itertools.islice(self._drive(conditions, size, labels_as), frames)

    def _drive(
        self, conditions: Conditions, size: tuple[int, int], labels_as: str
    ) -> Iterator[Frame]:
        block = functools.lru_cache(maxsize=64)(functools.partial(_block, self.seed, conditions))
        for index, pose in enumerate(_poses(self.seed, conditions)):
            seconds = index * FRAME_SECONDS
            bodies = [block(*corner) for corner in _nearby(pose)]
            bodies.append(_pack(_traffic(self.seed, conditions, pose, seconds)))
            labels = _paint(_background(self.seed, pose, size), bodies, pose)
            if conditions.noise:
                rng = _generator(conditions.seed, "noise", self.seed, index)
                labels = conditions.noise.apply(labels, rng)
            yield Frame(_convert(labels, labels_as), pose, f"{index:06d}")


class CityFiles(NamedTuple):
    """What `write_city` wrote: two folders of label PNGs, a CSV and a JSON file."""

    reference: Path
    query: Path
    poses: Path
    ground_truth: Path


def write_city(
    out: str | Path,
    frames: int,
    seed: int = 0,
    size: tuple[int, int] = (240, 320),
    query: Conditions = QUERY,
    labels_as: str = "cityscapes-trainids",
    radius: float = 5.0,
    progress: Callable[[int, int], None] | None = None,
) -> CityFiles:
    """Write two traverses of one city, their poses, and which frames show the same place.

    The label maps are 8-bit palette PNGs whose pixel values are the ids and whose palette is the
    label space's colours. ``poses.csv`` has a line ``frame,x,y,heading`` for each frame, named
    ``<sequence>/<name>``. ``ground_truth.json`` maps every query frame to the reference frames
    within `radius` metres whose headings differ by less than 45 degrees. Each file appears whole
    or not at all.

    A query traverse whose `spacing` is at most the reference's stays on the mapped stretch.

    Args:
        out: folder, made if missing; files of the same name in it are replaced.
        frames: frames of each traverse.
        seed, size, labels_as: as in `SyntheticCity` and `SyntheticCity.traverse`.
        query: conditions of the query traverse; those of the reference traverse are `REFERENCE`.
        radius: metres (>= 0).
        progress: called with (frames written, frames in all) after each frame.
    """
    _require(radius >= 0, "radius", radius, "metres >= 0")
    out, city = Path(out), SyntheticCity(seed)
    files = CityFiles(
        out / "reference", out / "query", out / "poses.csv", out / "ground_truth.json"
    )
    poses: dict[str, dict[str, Pose]] = {}
    for done, (folder, conditions) in enumerate(
        ((files.reference, REFERENCE), (files.query, query))
    ):
        traverse = city.traverse(frames, conditions, size, labels_as)
        poses[folder.name] = {}
        folder.mkdir(parents=True, exist_ok=True)
        for frame in traverse:
            _write(folder / f"{frame.name}.png", _palette_png(frame.labels, palette(labels_as)))
            poses[folder.name][f"{folder.name}/{frame.name}"] = frame.pose
            if progress:
                progress(done * frames + len(poses[folder.name]), 2 * frames)
    places = _same_places(poses["query"], poses["reference"], radius)
    _write(files.poses, _poses_csv(poses["reference"] | poses["query"]))
    _write(files.ground_truth, json.dumps(places, indent=1).encode())
    return files


# ---------------------------------------------------------------------------- route


class _Piece(NamedTuple):
    """A stretch of the route: where it begins, metres, and curvature in 1/m (left is positive)."""

    x: float
    y: float
    heading: float
    length: float
    curvature: float

    def at(self, metres: float) -> Pose:
        end = self.heading + self.curvature * metres
        if self.curvature == 0:
            x, y = metres * math.cos(end), metres * math.sin(end)
        else:
            x = (math.sin(end) - math.sin(self.heading)) / self.curvature
            y = (math.cos(self.heading) - math.cos(end)) / self.curvature
        return Pose(self.x + x, self.y + y, end)


def _route(seed: int) -> Iterator[_Piece]:
    """The centre line of the streets driven: from junction to junction, with rounded turns."""
    rng = _generator(seed, "route")
    node, heading = (0, 0), 0  # heading: quarter turns, -1 south, 0 east, 1 north
    x, y = _street(seed, 0, 0).position + TURN_RADIUS, _street(seed, 1, 0).position
    while True:
        node = (node[0] + (heading == 0), node[1] + heading)
        junction = (_street(seed, 0, node[0]).position, _street(seed, 1, node[1]).position)
        straight = math.dist((x, y), junction) - TURN_RADIUS
        turn = int(rng.choice((-1, 0, 0, 1) if heading == 0 else (0, -heading)))
        arc = TURN_RADIUS * (math.pi / 2 if turn else 2)
        approach = _Piece(x, y, heading * math.pi / 2, straight, 0.0)
        crossing = _Piece(*approach.at(straight), arc, turn / TURN_RADIUS)
        yield from (approach, crossing)
        x, y, _ = crossing.at(arc)
        heading += turn


def _poses(seed: int, conditions: Conditions) -> Iterator[Pose]:
    """Camera poses, `conditions.spacing` metres apart along the route, without end."""
    phases = _generator(conditions.seed, "sway", seed).uniform(0, math.tau, 2).tolist()
    left = conditions.lateral_offset - LANE
    travelled, begin = 0.0, 0.0
    for piece in _route(seed):
        while travelled < begin + piece.length:
            x, y, course = piece.at(travelled - begin)
            sway = math.sin(travelled / 17 + phases[0]) + math.sin(travelled / 5 + phases[1])
            turned = conditions.heading_offset + conditions.heading_jitter * sway
            heading = math.remainder(course + math.radians(turned), math.tau)
            yield Pose(x - left * math.sin(course), y + left * math.cos(course), heading)
            travelled += conditions.spacing
        begin += piece.length


# ---------------------------------------------------------------------------- bodies


class _Axis(NamedTuple):
    """A directed line on the map; (tx, ty) is its unit direction."""

    x: float
    y: float
    tx: float
    ty: float

    def point(self, s: float, d: float) -> tuple[float, float]:
        return self.x + s * self.tx - d * self.ty, self.y + s * self.ty + d * self.tx

    def at(self, s: float, d: float) -> _Axis:
        """The parallel axis that begins at (s, d)."""
        return _Axis(*self.point(s, d), self.tx, self.ty)

    def left(self) -> _Axis:
        """The axis turned a quarter to the left about its beginning."""
        return _Axis(self.x, self.y, -self.ty, self.tx)


Span = tuple[float, float]
Corners = list[tuple[float, float, float]]
Body = tuple[int, Corners]  # label id and eight corners


class _Bodies(NamedTuple):
    """Label ids (S,) and corners (S, 8, 3) of bodies; what lies flat is in order of painting."""

    labels: NDArray[np.uint8]
    corners: NDArray[np.float64]


def _pack(bodies: Iterable[Body]) -> _Bodies:
    listed = list(bodies)
    corners = np.array([corners for _, corners in listed], float).reshape(-1, 8, 3)
    return _Bodies(np.array([label for label, _ in listed], np.uint8), corners)


def _box(axis: _Axis, label: int, s: Span, d: Span, z: Span = (0, 0), inset: Span = (0, 0)) -> Body:
    """A box over the rectangle `s` x `d`, whose top is smaller by `inset` on each side."""
    corners = []
    for height, ds, dd in ((z[0], 0.0, 0.0), (z[1], *inset)):
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
            place = (s[0] + ds, s[1] - ds)[a], (d[0] + dd, d[1] - dd)[b]
            corners.append((*axis.point(*place), height))
    return label, corners


def _pole(axis: _Axis, height: float, thickness: float = 0.16, label: int = POLE) -> Body:
    half = thickness / 2
    return _box(axis, label, (-half, half), (-half, half), (0, height))


def _lamp(axis: _Axis, height: float) -> Iterator[Body]:
    """A street lamp; its arm reaches over the street, to the right of the axis."""
    yield _pole(axis, height)
    yield _box(axis, POLE, (-0.08, 0.08), (-1.8, 0), (height - 0.15, height))


def _sign(axis: _Axis, width: float) -> Iterator[Body]:
    """A traffic sign, square to the street."""
    yield _pole(axis, 2.2, 0.1)
    yield _box(axis, TRAFFIC_SIGN, (-0.05, 0.05), (-width / 2, width / 2), (2.0, 2.75))


def _traffic_light(axis: _Axis) -> Iterator[Body]:
    yield _pole(axis, 2.6)
    yield _box(axis, TRAFFIC_LIGHT, (-0.2, 0.2), (-0.2, 0.2), (2.5, 3.5))


def _person(axis: _Axis, label: int = PERSON, feet: float = 0.0) -> Iterator[Body]:
    yield _box(axis, label, (-0.2, 0.2), (-0.24, 0.24), (feet, feet + 1.45), (0.03, 0.03))
    yield _box(axis, label, (-0.1, 0.1), (-0.1, 0.1), (feet + 1.45, feet + 1.75))


def _rider(axis: _Axis) -> Iterator[Body]:
    yield _box(axis, BICYCLE, (-0.85, 0.85), (-0.1, 0.1), (0, 1.0), (0.3, 0.0))
    yield from _person(axis, RIDER, feet=0.25)


def _car(axis: _Axis, length: float = 4.3) -> Iterator[Body]:
    half = length / 2
    yield _box(axis, CAR, (-half, half), (-0.9, 0.9), (0.15, 0.85))
    yield _box(axis, CAR, (-half + 0.4, half - 1.0), (-0.85, 0.85), (0.8, 1.48), (0.55, 0.15))


def _tree(axis: _Axis, rng: np.random.Generator, season: str) -> Iterator[Body]:
    """A tree, all vegetation as in Cityscapes: a trunk, and a crown or bare boughs."""
    size, girth, evergreen = rng.random(3)
    height, radius = 5 + 6 * size, 1.4 + 1.6 * girth
    fork = 0.35 * height
    form = rng.uniform(-0.5, 0.5, (5, 5)).tolist()
    yield _pole(axis, fork + 0.5, 0.35, VEGETATION)
    if season == "summer" or evergreen > 0.85:
        yield from (_foliage(axis, radius, (fork, height), *ball) for ball in form)
    else:
        yield from (_bough(axis, 2 * radius, (fork, height), *bough[:3]) for bough in form)


def _foliage(
    axis: _Axis, radius: float, z: Span, s: float, d: float, up: float, wide: float, tall: float
) -> Body:
    """One of the irregular balls that make a crown; the five last numbers are in -0.5..0.5."""
    middle = axis.at(radius * s, radius * d)
    across, along = radius * (0.75 + 0.3 * wide), (z[1] - z[0]) * (0.4 + 0.15 * tall)
    height = sum(z) / 2 + radius * up
    return VEGETATION, [
        (*middle.point(across * a, across * b), height + along * c) for a, b, c in _BALL
    ]


def _bough(axis: _Axis, reach: float, z: Span, s: float, d: float, up: float) -> Body:
    """A thin pyramid from the fork of a tree outwards."""
    tip = (*axis.point(reach * s, reach * d), z[1] * (0.9 + 0.2 * up))
    foot = [(*axis.point(a, b), z[0]) for a, b in ((-0.1, 0), (0.1, 0), (0, -0.1), (0, 0.1))]
    return VEGETATION, foot + [tip] * 4


_BALL = ((1, 0, 0.3), (0.3, 0.9, -0.5), (-0.9, 0.4, 0.4), (-0.6, -0.7, -0.6),
         (0.5, -0.8, 0.4), (0, 0, 1), (0, 0, -1), (0.2, 0.3, -0.9))  # fmt: skip


# ---------------------------------------------------------------------------- city


class _Street(NamedTuple):
    """An endless street: x (axis 0, runs north) or y (axis 1, runs east) of its centre, width."""

    position: float
    width: float


class _Style(NamedTuple):
    """How a side of a block is built up; spans are metres, the rest are chances or label ids."""

    widths: Span
    heights: Span
    setbacks: Span
    margin: float  # left free on either side of a building
    open: float  # chance that a lot is not built up
    pitched: float  # chance of a pitched roof
    barrier: int  # between the sidewalk and what lies open
    yard: int


_STYLES = (
    _Style((9, 17), (9, 19), (0, 0), 0.0, 0.1, 0.3, WALL, SIDEWALK),  # terrace
    _Style((10, 16), (4, 7), (2, 7), 1.5, 0.25, 0.9, FENCE, TERRAIN),  # villas
    _Style((16, 16), (11, 11), (5, 5), 2.0, 0.0, 0.0, FENCE, TERRAIN),  # estate: all alike
    _Style((16, 26), (5, 10), (5.5, 7), 1.0, 0.3, 0.1, WALL, PARKING),  # works
    _Style((12, 24), (4, 6), (6, 7), 4.0, 0.8, 0.5, FENCE, TERRAIN),  # park
)


class _Side(NamedTuple):
    """A side of a block: its axis runs along the kerb, the block to the left."""

    axis: _Axis
    length: float
    style: _Style
    kerb: int  # label of the kerb strip
    walk: float  # from the kerb to the inner edge of the sidewalk, metres
    key: tuple[int, int, int]  # block and side number, for random generators


def _street(seed: int, axis: int, index: int) -> _Street:
    shift, width = _generator(seed, "street", axis, index).random(2).tolist()
    return _Street(index * PITCH + PITCH_JITTER * (2 * shift - 1), 8.0 + 5.0 * width)


def _nearby(pose: Pose) -> Iterator[tuple[int, int]]:
    """Blocks that come within `FAR` of the pose, and a few more."""
    column, row = math.floor(pose.x / PITCH), math.floor(pose.y / PITCH)
    return itertools.product(range(column - 2, column + 3), range(row - 2, row + 3))


def _block(seed: int, conditions: Conditions, column: int, row: int) -> _Bodies:
    """Everything between streets `column` and `column + 1`, `row` and `row + 1`."""
    sides = _sides(seed, column, row)
    bodies = list(_paving(sides))
    for side, following in zip(sides, sides[1:] + sides[:1], strict=True):
        bodies += _kerb_strip(seed, side)
        bodies += _lots(seed, side, following.walk + LOT_DEPTH, conditions.season)
        bodies += _furniture(seed, side)
        bodies += _street_trees(seed, side, conditions.season)
        bodies += _passers_by(seed, side, conditions)
    return _pack(bodies)


def _sides(seed: int, column: int, row: int) -> list[_Side]:
    """South, east, north and west side, counter-clockwise."""
    west, east = (_street(seed, 0, k) for k in (column, column + 1))
    south, north = (_street(seed, 1, k) for k in (row, row + 1))
    x0, x1 = west.position + west.width / 2, east.position - east.width / 2
    y0, y1 = south.position + south.width / 2, north.position - north.width / 2
    axes = (_Axis(x0, y0, 1, 0), _Axis(x1, y0, 0, 1), _Axis(x1, y1, -1, 0), _Axis(x0, y1, 0, -1))
    sides = []
    for number, axis in enumerate(axes):
        rng = _generator(seed, "side", column, row, number)
        style = _STYLES[rng.choice(len(_STYLES), p=(0.3, 0.25, 0.2, 0.15, 0.1))]
        kerb = int(rng.choice((PARKING, TERRAIN, SIDEWALK), p=(0.4, 0.3, 0.3)))
        length = (x1 - x0, y1 - y0)[number % 2]
        walk = KERB_STRIP + rng.uniform(1.5, 3.5)
        sides.append(_Side(axis, length, style, kerb, walk, (column, row, number)))
    return sides


def _paving(sides: list[_Side]) -> Iterator[Body]:
    """The block as one sidewalk with cut corners, and the ground inside its four sidewalks."""
    cut = [(*side.axis.point(s, 0), 0.0) for side in sides for s in (3.0, side.length - 3.0)]
    yield SIDEWALK, cut
    south, east, north, west = sides
    inside = TERRAIN if south.style.yard == TERRAIN else GROUND
    across = (west.walk, south.length - east.walk)
    yield _box(south.axis, inside, across, (south.walk, east.length - north.walk))


def _kerb_strip(seed: int, side: _Side) -> Iterator[Body]:
    """Parking bays or grass along the kerb; on some stretches a guard rail."""
    yield _box(side.axis, side.kerb, (7, side.length - 7), (0, KERB_STRIP))
    chance, begin, end = _generator(seed, "rail", *side.key).random(3)
    if chance < 0.4 and side.kerb != PARKING:
        rail = (6 + 8 * begin, side.length - 6 - 8 * end)
        yield from _fence(side.axis, GUARD_RAIL, rail, 0.3, (0.35, 0.85))


def _fence(axis: _Axis, label: int, s: Span, d: float, z: Span) -> Iterator[Body]:
    """A long thin thing along the axis, in pieces short enough to be sorted by distance."""
    stops = np.linspace(*s, max(2, math.ceil((s[1] - s[0]) / 5) + 1)).tolist()
    for piece in itertools.pairwise(stops):
        yield _box(axis, label, piece, (d, d + 0.2), z)


def _lots(seed: int, side: _Side, corner: float, season: str) -> Iterator[Body]:
    """Built-up and open lots, one after the other; the last `corner` metres are the next side's."""
    style = side.style
    s = side.walk
    for number in itertools.count():
        rng = _generator(seed, "lot", *side.key, number)
        width = rng.uniform(*style.widths)
        if s + width > side.length - corner:
            return
        lot = side.axis.at(s, side.walk)
        if rng.random() < style.open:
            yield from _open_lot(lot, width, style, rng, season)
        else:
            yield from _built_lot(lot, width, style, rng)
        s += width


def _open_lot(
    lot: _Axis, width: float, style: _Style, rng: np.random.Generator, season: str
) -> Iterator[Body]:
    """A barrier, here and there a hedge, and trees behind it."""
    yield _box(lot, style.yard, (0, width), (0, LOT_DEPTH))
    label = VEGETATION if rng.random() < 0.3 else style.barrier
    yield from _fence(lot, label, (0, width), 0.1, (0, rng.uniform(0.9, 2.0)))
    for s, d in rng.uniform((0, 3), (width, LOT_DEPTH), (3, 2)).tolist():
        yield from _tree(lot.at(s, d), rng, season)


def _built_lot(lot: _Axis, width: float, style: _Style, rng: np.random.Generator) -> Iterator[Body]:
    """A yard and a building: a box with a pitched roof, a smaller top floor, or neither."""
    setback, height = rng.uniform(*style.setbacks), rng.uniform(*style.heights)
    depth = min(12.0, LOT_DEPTH - setback)
    s, d = (style.margin, width - style.margin), (setback, setback + depth)
    yield _box(lot, style.yard, (0, width), (0, setback + 0.5))
    if style.barrier == FENCE:
        yield from _fence(lot, FENCE, (0, width), 0.1, (0, 1.0))
    yield _box(lot, BUILDING, s, d, (0, height))
    roof, along, rise = rng.random(3)
    if roof < style.pitched:
        ridge = (0, depth / 2) if along < 0.6 else ((s[1] - s[0]) / 2, 0)
        yield _box(lot, BUILDING, s, d, (height, height + 2.5 + 2 * rise), ridge)
    elif style.heights[0] < style.heights[1] and along < 0.5:
        left, right = np.sort(rng.uniform(*s, 2)).tolist()
        yield _box(lot, BUILDING, (left, right), d, (height, height + 2.5 + 3 * rise))


def _furniture(seed: int, side: _Side) -> Iterator[Body]:
    """Lamps, signs, and the traffic light or pole group at the side's beginning."""
    rng = _generator(seed, "lamps", *side.key)
    step, height, start = rng.uniform((20, 5, 4), (34, 9, 16)).tolist()
    for s in np.arange(start, side.length - 3, step).tolist():
        yield from _lamp(side.axis.at(s, 0.6), height)
    rng = _generator(seed, "signs", *side.key)
    for s, width in rng.uniform((5, 0.5), (side.length - 4, 1.2), (4, 2)).tolist():
        if rng.random() < 0.5:
            yield from _sign(side.axis.at(s, 0.8), width)
    column, row, number = side.key
    junction = column + (number in (1, 2)), row + (number in (2, 3))
    if _generator(seed, "junction", *junction).random() < 0.6:
        yield from _traffic_light(side.axis.at(3.6, 0.5))
    elif rng.random() < 0.5:
        yield _box(side.axis, POLE_GROUP, (3.4, 3.9), (0.5, 0.7), (0, 3.5))


def _street_trees(seed: int, side: _Side, season: str) -> Iterator[Body]:
    """An avenue on most kerb strips of grass, with trees missing here and there."""
    rng = _generator(seed, "trees", *side.key)
    step, avenue = rng.uniform(6, 12), rng.random() < 0.75
    if side.kerb == TERRAIN and avenue:
        for s in np.arange(8, side.length - 7, step).tolist():
            if rng.random() < 0.8:
                yield from _tree(side.axis.at(s, 1.3), rng, season)


# ---------------------------------------------------------------------------- traffic


def _passers_by(seed: int, side: _Side, conditions: Conditions) -> Iterator[Body]:
    """Parked cars, people on the sidewalk, riders at the kerb: other ones on every drive."""

    def scatter(kind: str, step: float, chance: float) -> Iterator[tuple[_Axis, float]]:
        """Places on the kerb line, each taken with a chance, and a number in 0..1 for each."""
        rng = _generator(conditions.seed, kind, seed, *side.key)
        for s in np.arange(8, side.length - 8, step).tolist():
            taken, shift, number = rng.random(3)
            if taken < min(0.95, chance * conditions.traffic):
                yield side.axis.at(s + 0.7 * shift, 0), number

    if side.kerb == PARKING:
        for place, number in scatter("bays", step=5.8, chance=0.55):
            yield from _car(place.at(0, 1.15), length=3.9 + number)
    if side.style.yard == PARKING:
        for place, number in scatter("yards", step=3.0, chance=0.5):
            yield from _car(place.at(0, side.walk + 2.6).left(), length=3.9 + number)
    for place, number in scatter("people", step=3.0, chance=0.15):
        yield from _person(place.at(0, KERB_STRIP + number * (side.walk - KERB_STRIP)))
    for place, number in scatter("riders", step=8.0, chance=0.08):
        yield from _rider(place.at(0, -0.5 - 0.4 * number))


def _traffic(seed: int, conditions: Conditions, pose: Pose, seconds: float) -> Iterator[Body]:
    """Vehicles driving on the streets around, on the right, none of them over the camera."""
    nearest = round(pose.x / PITCH), round(pose.y / PITCH)
    for axis, offset, forward in itertools.product((0, 1), (-1, 0, 1), (1, -1)):
        index = nearest[axis] + offset
        street = _street(seed, axis, index)
        aside = forward * street.width / 4
        if axis == 0:
            lane = _Axis(street.position + aside, 0, 0, forward)
        else:
            lane = _Axis(0, street.position - aside, forward, 0)
        rng = _generator(conditions.seed, "lane", seed, axis, index, forward)
        for vehicle, length in _lane(lane, conditions.traffic, pose, seconds, rng):
            if math.dist((vehicle.x, vehicle.y), (pose.x, pose.y)) > 4 + length / 2:
                yield from _vehicle(vehicle, length)


def _lane(
    lane: _Axis, traffic: float, pose: Pose, seconds: float, rng: np.random.Generator
) -> Iterator[tuple[_Axis, float]]:
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


def _vehicle(axis: _Axis, length: float) -> Iterator[Body]:
    """A car, a truck (7.5 m) or a bus (11 m)."""
    if length < 5:
        yield from _car(axis, length)
    else:
        label, height = (BUS, 3.1) if length > 10 else (TRUCK, 3.4)
        half = length / 2
        yield _box(axis, label, (-half, half), (-1.25, 1.25), (0.3, height), (0.1, 0.05))


# ---------------------------------------------------------------------------- picture


def _background(seed: int, pose: Pose, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Sky, road, and between them the roofs and trees of the horizon, too far to have parallax."""
    height, width = size
    across = (np.arange(width) + 0.5 - width / 2) / _focal(width)
    bearing = (pose.heading - np.arctan(across)) % math.tau
    heights, classes = _generator(seed, "horizon").random((2, 120))
    sector = (bearing / math.tau * 120).astype(int) % 120
    top = height / 2 - _focal(width) * np.tan(np.radians(0.3 + 3.5 * heights[sector]))
    rows = np.arange(height)[:, None] + 0.5
    far = np.where(classes[sector] < 0.6, BUILDING, VEGETATION)
    return np.where(rows < top, SKY, np.where(rows < height / 2, far, ROAD)).astype(np.uint8)


def _paint(canvas: NDArray[np.uint8], groups: list[_Bodies], pose: Pose) -> NDArray[np.uint8]:
    """Paint bodies over a background: what lies flat in its order, then what stands, far to near.

    Shape:
        canvas: (H, W) label ids. Output: the same.
    """
    seen = [_in_view(group, pose) for group in groups]
    labels = np.concatenate([labels for labels, _ in seen])
    corners = np.concatenate([corners for _, corners in seen])
    middle = corners.mean(axis=1)
    stands = np.ptp(corners[..., 2], axis=1) > 0
    distance = np.where(stands, np.hypot(middle[:, 0], middle[:, 1]), np.inf)
    order = np.argsort(-distance, kind="stable")
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    for index, outline in _outlines(corners, order, canvas.shape):
        draw.polygon(outline, fill=int(labels[index]))
    return np.array(image)


def _in_view(bodies: _Bodies, pose: Pose) -> _Bodies:
    """The bodies in the field of view, their corners in metres (ahead, to the right, up)."""
    east, north, up = np.moveaxis(bodies.corners - (pose.x, pose.y, CAMERA_HEIGHT), -1, 0)
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    ahead, right = east * cos + north * sin, east * sin - north * cos
    reach = math.tan(FIELD_OF_VIEW / 2) * ahead
    visible = (ahead > NEAR).any(axis=1) & (ahead < FAR).any(axis=1)
    visible &= (right < reach).any(axis=1) & (right > -reach).any(axis=1)
    corners = np.stack((ahead[visible], right[visible], up[visible]), axis=-1)
    return _Bodies(bodies.labels[visible], corners)


def _outlines(
    corners: NDArray[np.float64], order: NDArray[np.intp], shape: tuple[int, ...]
) -> Iterator[tuple[int, list[tuple[float, float]]]]:
    """Index and outline in pixels of each body of the `order` that is large enough to see."""
    whole = corners[..., 0].min(axis=1) > NEAR
    pixels = _project(corners, shape)
    large = np.ptp(pixels, axis=1).min(axis=1) > SMALLEST_PIXELS
    for index in order[(large | ~whole)[order]].tolist():
        points = pixels[index] if whole[index] else _project(_cut_near(corners[index]), shape)
        yield index, _hull(np.floor(points).tolist())


def _project(points: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Pixel coordinates (column, row) of points in metres (ahead, right, up)."""
    height, width = shape
    scale = _focal(width) / np.maximum(points[..., :1], NEAR)
    return points[..., 1:] * (1, -1) * scale + (width / 2, height / 2)


def _cut_near(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of the part of a convex body that is at least `NEAR` metres ahead.

    Every line from a corner behind to a corner ahead lies in the body, so adding the points where
    these lines pass the near plane gives the cut body, without knowing its edges.
    """
    ahead = corners[corners[:, 0] >= NEAR]
    behind = corners[corners[:, 0] < NEAR]
    start, step = behind[:, None], ahead[None] - behind[:, None]
    passing = start + step * (NEAR - start[..., :1]) / step[..., :1]
    return np.concatenate((ahead, passing.reshape(-1, 3)))


def _hull(points: list[list[float]]) -> list[tuple[float, float]]:
    """Convex hull by Andrew's monotone chain."""
    ordered = sorted(set(map(tuple, points)))
    outline: list[tuple[float, float]] = []
    for chain in (ordered, ordered[::-1]):
        begin = len(outline)
        for x, y in chain:
            while len(outline) - begin > 1:
                (ax, ay), (bx, by) = outline[-2:]
                if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                    break
                outline.pop()
            outline.append((x, y))
    return outline


def _focal(width: int) -> float:
    """Focal length in pixels."""
    return width / 2 / math.tan(FIELD_OF_VIEW / 2)


# ---------------------------------------------------------------------------- files


def _convert(labels: NDArray[np.uint8], labels_as: str) -> NDArray[np.uint8]:
    if labels_as == "cityscapes-ids":
        return labels
    train_ids = np.full(256, 255, np.uint8)
    train_ids[list(TRAIN_IDS)] = list(TRAIN_IDS.values())
    return train_ids[labels]


def _same_places(
    query: dict[str, Pose], reference: dict[str, Pose], radius: float
) -> dict[str, list[str]]:
    """For each query frame the reference frames that show the same place."""
    names, poses = list(reference), np.array(list(reference.values()))
    places = {}
    for name, pose in query.items():
        x, y, heading = (poses - pose).T
        same = (np.hypot(x, y) <= radius) & (np.cos(heading) > math.cos(math.pi / 4))
        places[name] = [names[index] for index in np.flatnonzero(same)]
    return places


def _poses_csv(poses: dict[str, Pose]) -> bytes:
    lines = [",".join(("frame", *Pose._fields))]
    lines += [f"{name},{pose.x!r},{pose.y!r},{pose.heading!r}" for name, pose in poses.items()]
    return ("\n".join(lines) + "\n").encode()


def _palette_png(labels: NDArray[np.uint8], colours: NDArray[np.uint8]) -> bytes:
    image = Image.fromarray(labels)
    image.putpalette(colours.tobytes())
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    return buffer.getvalue()


def _write(path: Path, content: bytes) -> None:
    """Write a file so that it is either whole or not there."""
    unfinished = path.with_name(f".{path.name}.part")
    unfinished.write_bytes(content)
    unfinished.replace(path)
