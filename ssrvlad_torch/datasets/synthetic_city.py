"""A deterministic synthetic city: label maps and poses of sequences along one route.

An infinite grid of streets at irregular distances has blocks between them; each side of a block has
its own random generator, so any part can be computed alone. Every object is a convex body of eight
corners. Coordinates are in metres, x east, y north, z up, angles counter-clockwise from east.
Streets and walls are described in (s, d): metres along an axis, and to its left."""

import functools
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..files import empty_folder, replacing
from ..taxonomy import label_space, palette
from .city.blocks import Bodies, block_sides, changing_bodies, fixed_bodies, pack, vehicles
from .city.rendering import background, paint
from .city.streets import Conditions, camera_poses, generator, nearby_blocks
from .pose_tables import write_poses
from .poses import Pose
from .segmentation_noise import add_errors

FRAME_SECONDS = 1 / 3
RADIUS = 5.0

REFERENCE = Conditions()
QUERY = Conditions(
    spacing=2.7, lateral_offset=0.7, heading_jitter=2.0, season="winter", noise=1.0, seed=1
)

LEFT, STRAIGHT, RIGHT = 1, 0, -1
TOUR = tuple("R-L".index(turn) - 1 for turn in "----L-L----L-L--L-R-R-R---R-LL-L----LL---")
"""Turns of a route of 3.3 km with loops, left, right or straight on: around ten blocks, then along
some of these streets again in the same direction and in the opposite one."""
TOUR_ESTATES = (2,)
"""The estate of the tour: 400 m of street that look alike."""


class CityFrame(NamedTuple):
    """One frame: label ids ``(H, W)`` uint8, camera pose, name ``000000``..."""

    labels: NDArray[np.uint8]
    pose: Pose
    name: str


@dataclass(frozen=True)
class SyntheticCity:
    """A city of a seed >= 0 and a route through it; equal seeds give equal frames. On the east-west
    streets with the numbers ``estates``, 0 for the first of the route, all blocks are alike.

    Examples:
        >>> frame = next(SyntheticCity(seed=0).traverse(frames=1))
        >>> frame.labels.shape, frame.name
        ((240, 320), '000000')
    """

    seed: int = 0
    estates: tuple[int, ...] = ()

    def traverse(
        self,
        frames: int,
        conditions: Conditions = REFERENCE,
        size: tuple[int, int] = (240, 320),
        labels_as: str = "cityscapes-trainids",
        turns: Iterable[int] | None = None,
    ) -> Iterator[CityFrame]:
        """The frames of a sequence along the route, rendered one by one; fewer than ``frames`` if
        it ends. The route starts eastwards; ``turns`` are 1 for left, 0 for straight on and -1 for
        right at each junction, ``None`` an endless route that never crosses itself. Train ids are
        255 for classes without one."""
        names = {label.name: label.id for label in label_space(labels_as).classes}
        ids = np.full(256, 255, np.uint8)  # of the label space, 255 for a class that it lacks
        for label in label_space("cityscapes-ids").classes:
            if label.id >= 0:
                ids[label.id] = names.get(label.name, 255)

        @functools.lru_cache(maxsize=64)
        def block(column: int, row: int) -> Bodies:
            """All bodies between streets `column` and `column + 1`, `row` and `row + 1`."""
            sides = block_sides(self.seed, column, row, self.estates)
            changing = (changing_bodies(self.seed, side, conditions) for side in sides)
            fixed = fixed_bodies(self.seed, sides, conditions.season)
            return pack(itertools.chain(fixed, *changing))

        poses = camera_poses(self.seed, conditions, turns)
        for index, pose in enumerate(itertools.islice(poses, frames)):
            bodies = [block(*corner) for corner in nearby_blocks(pose)]
            bodies.append(pack(vehicles(self.seed, conditions, pose, index * FRAME_SECONDS)))
            labels = paint(background(self.seed, pose, size), bodies, pose)
            if conditions.noise:
                rng = generator(conditions.seed, "noise", self.seed, index)
                labels = add_errors(labels, conditions.noise, rng)
            yield CityFrame(ids[labels], pose, f"{index:06d}")


def write_city(
    out: str | Path,
    frames: int,
    seed: int = 0,
    size: tuple[int, int] = (240, 320),
    labels_as: str = "cityscapes-trainids",
    progress: Callable[[int], object] = lambda _: None,
) -> Path:
    """Writes two sequences into a new or empty folder, which it returns: ``reference`` and
    ``query``, in the conditions `REFERENCE` and `QUERY`, as palette PNGs; ``poses.csv``; and
    ``ground_truth.json``, the reference frames within `RADIUS` metres and 45 degrees of each query
    frame. Another folder is a ValueError."""
    city, out = SyntheticCity(seed), empty_folder(Path(out))
    colours, poses = palette(labels_as), dict[str, dict[str, Pose]]()
    for name, conditions in (("reference", REFERENCE), ("query", QUERY)):
        sequence = city.traverse(frames, conditions, size, labels_as)
        poses[name] = _write_frames(out / name, sequence, colours, progress)
    names, references = list(poses["reference"]), np.array(list(poses["reference"].values()))
    matches = {}
    for name, pose in poses["query"].items():
        x, y, heading = (references - pose).T
        same = (np.hypot(x, y) <= RADIUS) & (np.cos(heading) > math.cos(math.pi / 4))
        matches[name] = [names[index] for index in np.flatnonzero(same)]
    write_poses(out / "poses.csv", poses["reference"] | poses["query"])
    with replacing(out / "ground_truth.json") as temporary:
        temporary.write_text(json.dumps(matches, indent=1), encoding="utf-8")
    return out


def write_tour(
    out: str | Path,
    frames: int | None = None,
    seed: int = 0,
    size: tuple[int, int] = (240, 320),
    progress: Callable[[int], object] = lambda _: None,
) -> Path:
    """Writes one sequence along `TOUR` into a new or empty folder: ``poses.csv``, and label PNGs in
    the folder ``tour``, which it returns; at most ``frames``, or all 1100. Errors as for
    `write_city`."""
    folder = empty_folder(Path(out)) / "tour"
    city = SyntheticCity(seed, TOUR_ESTATES)
    sequence = city.traverse(sys.maxsize if frames is None else frames, size=size, turns=TOUR)
    poses = _write_frames(folder, sequence, palette("cityscapes-trainids"), progress)
    write_poses(folder.with_name("poses.csv"), poses)
    return folder


def _write_frames(
    folder: Path,
    frames: Iterable[CityFrame],
    colours: NDArray[np.uint8],
    progress: Callable[[int], object],
) -> dict[str, Pose]:
    """Writes frames as label PNGs and returns their poses by id."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = {}
    for frame in frames:
        image = Image.fromarray(frame.labels)
        image.putpalette(colours.tobytes())
        with replacing(folder / f"{frame.name}.png") as temporary:
            image.save(temporary, format="PNG")
        poses[f"{folder.name}/{frame.name}"] = frame.pose
        progress(1)
    return poses
