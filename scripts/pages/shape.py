#!/usr/bin/env python3
"""Writes docs/shape.md: what of a layer's shape carries, and what the skeleton is worth.

    .venv/bin/python scripts/pages/shape.py --data ../shared/data

The folder holds `camvid`, `uofa` and `gardens_walk`. Every condition has two halves.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import steps
import torch
from _markdown import head_row, row, write
from _trials import Cache
from conditions import (
    CITY_CONDITIONS,
    METRES,
    SPACES,
    Describe,
    Drive,
    Masks,
    camvid,
    city,
    described_by,
    described_by_baseline,
    described_from_masks,
    every_other,
)
from torch import Tensor

from ssrvlad_torch import follow, standardise
from ssrvlad_torch.config import SSRVLADConfig
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers, from_poses
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.taxonomy import label_space

NETWORKS = ("espnetv2", "dabnet")
ROUTES = {
    "evening -> day": ("uofa/evening", "uofa/day", 3),
    "right -> left": ("gardens_walk/day_right", "gardens_walk/day_left", 2),
    "night -> right": ("gardens_walk/night_right", "gardens_walk/day_right", 2),
    "night -> left": ("gardens_walk/night_right", "gardens_walk/day_left", 2),
}
DRIVES = ("0001TP", "0016E5")
CAMVID = (
    ("labels", "labels"),
    ("predicted_espnetv2", "labels"),
    ("predicted_dicenet", "predicted_espnetv2"),
    ("predicted_espnetv2", "predicted_espnetv2"),
)
SEEDS = ((10,), (20,))
STREETS = ("noise 4", "4 m aside", "heading +-10", "all together")
HALVES = ("chosen", "other")
GROUPS = ("real", "CamVid", "city")

HEAD = f"""# Shape

Written by `scripts/pages/shape.py`; no number is typed by hand. What of a layer's shape says where
a picture was taken: its area, its skeleton, its boundaries?

RecallRate@1 of single frames, the mean over conditions, each with two halves. *Chosen* is the half
on which directions, bins and weights of `default` were chosen. *Other* is the second half of each
real route, the other drive of CamVid, another city. It had no say in these, and was in view when
the 480 numbers were divided between six layers and the boundaries: of that it is no clean test.
*Standardised* is with each traverse's own mean taken off, *followed* the same as a sequence,
online.

- *real*: {len(ROUTES)} pairs of traverses through change (campus by day and in the evening, a walk
  on the left, on the right and at night), label maps of {len(NETWORKS)} networks that were trained
  elsewhere.
- *CamVid*: odd against even frames of one drive, labels and the outputs of two networks; all frames
  of a stop are one place.
- *city*: {len(SEEDS[0])} city a half, {", ".join(STREETS)}, within {METRES:g} m.
"""

READING = """## What it says

- **The skeleton is worth little**: its lengths in place of the boundaries are no better than more
  numbers for the area, but for real routes on the half that was looked at. Added to the preset, 48
  numbers of it bring at most two queries in a hundred. It stays in `paper`, whose idea it is.
- **Boundaries** bring most where networks err: on the real routes, and most of all once a sequence
  is followed. Where only the labels are noisy, as in the city, and on single raw frames of the
  other half, area alone is as good.
- **Beside unlabelled pixels, too**: without the outlines of what moves, half of the gain is lost.
- **The boundaries of each layer by itself** are better on real routes and worse on CamVid.
- **Merging what networks confuse**, and weights by how well neighbouring frames agree, do not gain
  everywhere: ground and sidewalk as one nowhere clearly, buildings and vegetation as one lose, the
  weights gain on the chosen half more than on the other. None of them is in the package.
- **960 numbers** gain a little here and lose a little there: they do not earn twice the memory, and
  are no preset.
"""


class Search(NamedTuple):
    """Queries, references and true matches."""

    queries: Drive
    references: Drive
    truth: list[np.ndarray]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, required=True)
    arguments.add_argument("--output", type=Path, default=Path("docs/shape.md"))
    arguments.add_argument("--cache", type=Path, default=Path(".cache/shape"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    kept = Cache(options.cache)
    measured = {
        name: kept.get(
            (name, SSRVLADConfig().fingerprint, *SEEDS), partial(measure, describe, options.data)
        )
        for name, describe in ways().items()
    }
    write(options.output, "\n".join(page(measured)) + "\n")


def page(measured: dict[str, dict[str, list[float]]]) -> Iterator[str]:
    yield HEAD
    for number, title in enumerate(("Raw", "Standardised", "Followed")):
        yield f"## {title}\n"
        yield from head_row("", *(f"{group}, {half}" for group in GROUPS for half in HALVES))
        for name, found in measured.items():
            rates = [found[f"{group}, {half}"][number] for group in GROUPS for half in HALVES]
            yield row(name, *(f"{rate:.3f}" for rate in rates))
        yield ""
    yield READING


def ways() -> dict[str, Describe]:
    """Ways to describe, by name. All have 480 numbers where nothing else is said."""
    default = SSRVLADConfig()
    return {
        "default": described_by(default),
        "label grid": described_by_baseline("label-grid"),
        "area alone": described_from_masks(steps.area_alone),
        "area and skeleton": described_from_masks(steps.skeleton_in_place_of_boundaries),
        "area, boundaries and skeleton (528)": described_from_masks(steps.skeleton_lengths_too),
        "boundaries of each layer": described_from_masks(boundaries_of_each_layer),
        "boundaries between labelled pixels": described_from_masks(steps.between_labelled_pixels),
        "boundaries alone (4 x 114)": described_from_masks(boundaries_alone),
        "ground and sidewalk as one": described_from_masks(partial(steps.with_merged, 0, 1)),
        "buildings and vegetation as one": described_from_masks(partial(steps.with_merged, 2, 4)),
        "weighted by agreement": steps.weighted_by_agreement(described_by(default)),
        "960 numbers": steps.harmonics(SSRVLADConfig(harmonics=108, boundary_harmonics=78)),
    }


def boundaries_of_each_layer(masks: Masks) -> Tensor:
    """Area with 40 numbers, the directions of each layer's own boundary with 10 each."""
    return steps.with_boundaries_of_each_layer(masks, 40, 10)


def boundaries_alone(masks: Masks) -> Tensor:
    """Four directions with as many numbers as there are."""
    return steps.described(steps.cells(masks), (0, 114))


def measure(describe: Describe, data: Path) -> dict[str, list[float]]:
    """Group and half -> mean rates: raw, standardised, followed."""
    known: dict[int, Tensor] = {}

    def of(drive: Drive) -> Tensor:
        if id(drive) not in known:
            known[id(drive)] = describe(drive)
        return known[id(drive)]

    found = {}
    for group, searches in (("real", real), ("CamVid", in_camvid), ("city", in_city)):
        for half in range(2):
            rates = [rates_of(search, of) for search in searches(data, half)]
            found[f"{group}, {HALVES[half]}"] = np.mean(rates, 0).tolist()
    print(found, flush=True)
    return found


def rates_of(search: Search, of: Callable[[Drive], Tensor]) -> list[float]:
    queries, references = of(search.queries), of(search.references)
    alike = score(standardise(queries), standardise(references))
    names = ["", ""]
    rows = (
        score(queries, references).argmax(1),
        alike.argmax(1),
        follow(alike, names[:1] * len(references), mode="online").indices[:, 0],
    )
    return [rate(found.numpy(), search.truth) for found in rows]


def rate(rows: np.ndarray, truth: list[np.ndarray]) -> float:
    """RecallRate@1 over the queries that have a true match."""
    right = [row in true for row, true in zip(rows, truth, strict=True) if len(true)]
    return float(np.mean(right))


def real(data: Path, half: int) -> Iterator[Search]:
    for network in NETWORKS:
        for queries, references, reach in ROUTES.values():
            here, there = (part_of(data / each, network, half) for each in (queries, references))
            truth = from_frame_numbers(_numbers(here), _numbers(there), reach)
            yield Search(here, there, truth)


def _numbers(drive: Drive) -> list[str]:
    return [str(number) for number in range(len(drive.frames))]


@cache
def part_of(folder: Path, network: str, half: int) -> Drive:
    """A half of a real traverse as a network sees it."""
    files = find_label_files([str(folder / f"predicted_{network}")], folder.name)
    files = files[: len(files) // 2] if half == 0 else files[len(files) // 2 :]
    space = label_space("cityscapes-trainids")
    maps = np.stack([read_label_map(file, space) for file in files])
    frames = tuple(file.frame for file in files)
    return Drive(frames, np.full((len(files), 3), np.nan), maps, space.name)


def in_camvid(data: Path, half: int) -> Iterator[Search]:
    same = json.loads((data / "camvid" / "same_place_odd_even.json").read_text())
    for query, reference in CAMVID:
        queries, references = (
            every_second(data / "camvid", kind, DRIVES[half], start)
            for kind, start in ((query, 1), (reference, 0))
        )
        at = {frame: number for number, frame in enumerate(references.frames)}
        truth = [np.array([at[frame] for frame in same[query]]) for query in queries.frames]
        yield Search(queries, references, truth)


@cache
def every_second(folder: Path, kind: str, name: str, start: int) -> Drive:
    drive = camvid(folder, kind)
    rows = [row for row in every_other(drive, start) if drive.sequences[row] == name]
    frames = tuple(drive.frames[row] for row in rows)
    return Drive(frames, drive.poses[rows], drive.maps[rows], SPACES[kind])


def in_city(_: Path, half: int) -> Iterator[Search]:
    for seed in SEEDS[half]:
        references = city(seed, REFERENCE)
        for name in STREETS:
            for conditions in CITY_CONDITIONS[name]:
                queries = city(seed, conditions)
                yield Search(
                    queries, references, from_poses(queries.poses, references.poses, METRES)
                )


if __name__ == "__main__":
    main()
