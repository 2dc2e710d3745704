#!/usr/bin/env python3
"""Writes docs/way-back.md: is a street recognised in the opposite direction?

.venv/bin/python scripts/pages/way_back.py
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _markdown import head_row, row, write
from _tours import BATCH, CONDITIONS, LABELS_AS, head
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, one_hot

from ssrvlad_torch import follow, standardise
from ssrvlad_torch.datasets.city.conditions import Conditions
from ssrvlad_torch.datasets.city.streets import camera_poses
from ssrvlad_torch.datasets.poses import Pose
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.taxonomy import label_space

FRAMES, SIZE = 200, (120, 160)
LEARNED_ON, MEASURED_ON, ELSEWHERE = (3,), (0, 1, 2), 100
LANE, METRES, PRECISION, SEARCHED = 3.5, 5.0, 0.99, 80.0
ROWS, STRIPS = 8, 8

HEAD = f"""# The way back

Written by `scripts/pages/way_back.py`. Can a street be recognised in the opposite direction?
**No**: some frames get the right place, but no threshold separates them from the wrong ones. What
is near the camera on the way there is far from it on the way back. The package has no option for
it.

A street of the synthetic city is driven once, {FRAMES} frames, and then back on the other lane;
{len(MEASURED_ON)} cities are measured. The camera of the way back sees what was behind the camera
of the way there. The frame of the map that shows the same part of the street was therefore taken
some metres earlier. This distance (*metres before*) is learned in another city. A match is right
within {METRES:g} m of it. *Recall at {PRECISION:g}* is the recall at precision {PRECISION:g}, with
further queries from a street that is not in the map.

- *mirrored*: the label map of the way back is mirrored left to right, because left and right are
  exchanged.
- *sides*: instead of the descriptor, the classes at the left and the right edge of the view, by
  height. Both cameras see these from nearly the same place.
- *followed*: the sequence is followed through the map in reverse order.
"""


class Way(NamedTuple):
    """How frames are described, and whether those of the way back are mirrored before."""

    describe: Callable[[Tensor], Tensor]
    mirrored: bool


def whole(labels: Tensor) -> Tensor:
    """``(B, 480)``, the descriptor."""
    found: Tensor = head()(labels)
    return found


def sides(labels: Tensor) -> Tensor:
    """``(B, D)``: the square root of the fraction of each layer in cells at both edges."""
    categories = torch.full((256,), 8)
    for one in label_space(LABELS_AS).classes:
        categories[one.id] = one.category_index
    layers = one_hot(categories[labels.long()], 9)[..., :8].permute(0, 3, 1, 2).float()
    cells = adaptive_avg_pool2d(layers, (ROWS, STRIPS))
    edges = torch.cat((cells[..., :2], cells[..., -2:]), -1)
    return edges.flatten(1).sqrt()


WAYS = {
    "default": Way(whole, False),
    "default, mirrored": Way(whole, True),
    "sides, mirrored": Way(sides, True),
}


class Drives(NamedTuple):
    """Label maps or descriptors of a street driven there and back, and of another street; metres
    along the street of the frames of the map."""

    there: Tensor
    back: Tensor
    other: Tensor
    along: np.ndarray


class Found(NamedTuple):
    """For each query the metres from its candidate to it, in the direction of the way back (NaN if
    it is not in the map), and its score."""

    metres: np.ndarray
    sure: np.ndarray


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--output", type=Path, default=Path("docs/way-back.md"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    write(options.output, "\n".join(page()) + "\n")


def page() -> Iterator[str]:
    yield HEAD
    for name, conditions in CONDITIONS.items():
        cities = {city: drives(city, conditions) for city in (*LEARNED_ON, *MEASURED_ON)}
        yield f"## {name.capitalize()}\n"
        columns = ("metres before", "recall@1", f"recall at {PRECISION:g}")
        yield from head_row("", *columns, *(f"{column}, followed" for column in columns))
        for words, way in WAYS.items():
            seen = {city: seen_by(way, street) for city, street in cities.items()}
            figures = []
            for followed in (False, True):
                before = offset([found(seen[city], followed) for city in LEARNED_ON])
                measured = [found(seen[city], followed) for city in MEASURED_ON]
                figures += [f"{before:.0f}", *(f"{each:.3f}" for each in rates(measured, before))]
            yield row(words, *figures)
        yield ""


def drives(city: int, conditions: Conditions) -> Drives:
    poses = list(islice(camera_poses(city, conditions), FRAMES))
    steps = [np.hypot(*np.subtract(b[:2], a[:2])) for a, b in pairwise(poses)]
    back = [across(pose) for pose in reversed(poses)]
    other = islice(camera_poses(city + ELSEWHERE, conditions), FRAMES)
    maps = [labels(seed, list(each), conditions) for seed, each in
            ((city, poses), (city, back), (city + ELSEWHERE, other))]  # fmt: skip
    print(f"city {city}", flush=True)
    return Drives(*maps, np.cumsum([0.0, *steps]))


def across(pose: Pose) -> Pose:
    """The pose on the other lane, in the opposite direction."""
    x, y, heading = pose
    aside = heading + np.pi / 2
    return Pose(x + LANE * np.cos(aside), y + LANE * np.sin(aside), heading + np.pi)


def labels(city: int, poses: Sequence[Pose], conditions: Conditions) -> Tensor:
    frames = SyntheticCity(city)._drive(poses, conditions, SIZE, LABELS_AS)
    return torch.from_numpy(np.stack([frame.labels for frame in frames]))


def seen_by(way: Way, street: Drives) -> Drives:
    """Standardised descriptors of the drives."""

    def described(views: Tensor, mirrored: bool) -> Tensor:
        views = views.flip(2) if mirrored else views
        return standardise(torch.cat([way.describe(part) for part in views.split(BATCH)]))

    others = (described(views, way.mirrored) for views in (street.back, street.other))
    return Drives(described(street.there, False), *others, street.along)


def found(street: Drives, followed: bool) -> Found:
    """Candidates for the way back, then for the other street."""
    known = street.there
    metres, sure = [], []
    for number, views in enumerate((street.back, street.other)):
        scores = score(views, known)
        best, rows = scores.max(1)
        if followed:
            places = follow(scores.flip(1), [""] * len(known))
            best, rows = places.near, len(known) - 1 - places.indices[:, 0]
        here = street.along[::-1] if number == 0 else np.full(len(rows), np.nan)
        metres.append(here - street.along[rows.numpy()])
        sure.append(best.numpy())
    return Found(np.concatenate(metres), np.concatenate(sure))


def offset(learned: Sequence[Found]) -> float:
    """Metres before a query of the frame of the map that is most similar to it."""
    metres = np.concatenate([each.metres for each in learned])
    counts = [np.sum(np.abs(metres - at) <= METRES) for at in range(int(SEARCHED))]
    return float(np.argmax(counts))


def rates(measured: Sequence[Found], before: float) -> tuple[float, float]:
    """Recall of all first candidates, and recall at `PRECISION`."""
    metres, sure = (np.concatenate(part) for part in zip(*measured, strict=True))
    right, queries = np.abs(metres - before) <= METRES, np.sum(~np.isnan(metres))
    order = np.argsort(-sure, kind="stable")
    hits = np.cumsum(right[order])
    precise = np.flatnonzero(hits / np.arange(1, len(hits) + 1) >= PRECISION)
    return right.sum() / queries, hits[precise[-1]] / queries if len(precise) else 0.0


if __name__ == "__main__":
    main()
