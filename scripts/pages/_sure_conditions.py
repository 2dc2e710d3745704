"""Queries and maps of `how_sure.py` and `_loops_real.py`, with their descriptors and true matches.

The folder of the data holds `camvid`, `uofa`, `gardens_walk` and `networks`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _described import OURS, swept
from conditions import (
    CAMVID_CONDITIONS,
    CITY_CONDITIONS,
    METRES,
    NETWORKS,
    ROUTES,
    TRAIN_IDS,
    Drive,
    city,
    kept,
    labelled,
    pictured,
)
from torch import Tensor

from ssrvlad_torch import Segmenter
from ssrvlad_torch.baselines.hog import HOG
from ssrvlad_torch.baselines.label_grid import LabelGrid
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.evaluation.ground_truth import from_poses
from ssrvlad_torch.recognition.sweep import COLUMNS

FOREIGN = (
    ("uofa/evening", "gardens_walk/day_left"),
    ("gardens_walk/day_left", "uofa/day"),
    ("gardens_walk/night_right", "uofa/evening"),
    ("camvid/0016E5", "uofa/day"),
    ("uofa/day", "camvid/0016E5"),
    ("camvid/0001TP", "camvid/0016E5"),
)
DRIVES = ("0001TP", "0016E5")
STREETS = ("clean", "noise 4", "4 m aside", "all together")
METHODS = ("label maps", "features", "HOG", "label grid", "fused")


class Condition(NamedTuple):
    """Queries, a map and the true matches of a method."""

    group: str
    name: str
    method: str
    queries: Tensor
    references: Tensor
    truth: Sequence[np.ndarray]
    beside: Mapping[str, tuple[Tensor, Tensor]]


def conditions(data: Path, cached: Path) -> Iterator[Condition]:
    """All conditions, with descriptors."""
    for method, network in RUNS:
        of = partial(pair_of, data, cached, method, network)
        for first, second, reach in ROUTES.values():
            for queries, references in ((first, second), (second, first)):
                here, there, beside = of(queries, references)
                rows = np.arange(len(here))
                truth = [np.flatnonzero(abs(rows - number) <= reach) for number in rows]
                title = f"{queries} -> {references}, {network}"
                yield Condition("real", title, method, here, there, truth, beside)
                if (queries, references) == (first, second):
                    half = len(there) // 2
                    left = [true[true < half] for true in truth]
                    beside = {name: (q, r[:half]) for name, (q, r) in beside.items()}
                    yield Condition("half map", title, method, here, there[:half], left, beside)
        for queries, references in FOREIGN:
            here, there, beside = of(queries, references)
            truth = [np.zeros(0, int)] * len(here)
            title = f"{queries} -> {references}, {network}"
            yield Condition("foreign", title, method, here, there, truth, beside)
    yield from in_camvid(data, cached)
    yield from in_cities(cached)


RUNS = [
    (method, network) for method in METHODS for network in ([""] if method == "HOG" else NETWORKS)
]


def pair_of(
    data: Path, cached: Path, method: str, network: str, queries: str, references: str
) -> tuple[Tensor, Tensor, dict[str, tuple[Tensor, Tensor]]]:
    """The descriptors of queries and of a map by a method, and those beside them."""
    folders = queries, references
    by = "label maps" if method == "fused" else method
    here, there = (described(data, cached, by, network, folder) for folder in folders)
    beside = {}
    if method == "fused":
        signs = [described(data, cached, "features", network, folder) for folder in folders]
        beside = {"features": (signs[0], signs[1])}
    return here, middle(there), beside


def in_camvid(data: Path, cached: Path) -> Iterator[Condition]:
    for each in of_camvid(data):
        here, there = of_kinds(data, cached, each)
        yield Condition("real", each.name, "label maps", here, middle(there), each.truth, {})
    for drive, (method, network) in product(DRIVES, RUNS):
        if method == "label maps":
            continue
        each = next(each for each in of_camvid(data) if each.drive == drive)
        here, there, beside = pair_of(data, cached, method, network, *[f"camvid/{drive}"] * 2)
        beside = {name: (q[each.odd], r[each.even]) for name, (q, r) in beside.items()}
        pair = here[each.odd], there[each.even]
        yield Condition("real", f"{drive}, {network}", method, *pair, each.truth, beside)


class OddEven(NamedTuple):
    """Odd frames of a drive of CamVid by one kind of label maps against even ones by another."""

    name: str
    drive: str
    kinds: tuple[str, str]
    odd: np.ndarray
    even: np.ndarray
    truth: list[np.ndarray]


def of_camvid(data: Path) -> Iterator[OddEven]:
    same = json.loads((data / "camvid" / "same_place_odd_even.json").read_text())
    for drive in DRIVES:
        names = [file.stem for file in sorted((data / "camvid" / drive / "labels").iterdir())]
        odd, even = np.arange(1, len(names), 2), np.arange(0, len(names), 2)
        at = {f"{drive}/{names[row]}": number for number, row in enumerate(even)}
        truth = [np.array([at[frame] for frame in same[f"{drive}/{names[n]}"]]) for n in odd]
        for name, kinds in CAMVID_CONDITIONS.items():
            yield OddEven(f"{drive}, {name}", drive, kinds, odd, even, truth)


def of_kinds(data: Path, cached: Path, each: OddEven) -> Iterator[Tensor]:
    """Label maps of the queries and of the references."""
    for kind, rows in zip(each.kinds, (each.odd, each.even), strict=True):
        space = "camvid-11" if kind == "labels" else TRAIN_IDS
        yield described(data, cached, "label maps", kind, f"camvid/{each.drive}", space)[rows]


def in_cities(cached: Path) -> Iterator[Condition]:
    for seed in range(3):
        references = city(seed, REFERENCE)
        there = middle(of_city(cached, seed, "reference"))
        for name in STREETS:
            queries = city(seed, CITY_CONDITIONS[name][0])
            truth = from_poses(queries.poses, references.poses, METRES)
            here = of_city(cached, seed, name)
            yield Condition("city", f"city {seed}, {name}", "label maps", here, there, truth, {})


@cache
def of_city(cached: Path, seed: int, name: str) -> Tensor:
    def make() -> Tensor:
        conditions = REFERENCE if name == "reference" else CITY_CONDITIONS[name][0]
        return swept(city(seed, conditions), OURS)

    return kept(cached / f"city {seed} {name}.pt", make)


@cache
def described(
    data: Path, cached: Path, method: str, network: str, folder: str, space: str = ""
) -> Tensor:
    """The descriptors of a folder by a method; of label maps ``(N, S, 480)``. The networks whose
    label maps are stored with CamVid are others than those of the other folders."""
    named = f"{method} {network} {folder}".replace("/", " ")
    files = find_image_files([str(data / folder / "images")])
    maps = data / folder / (network if space else f"predicted_{network}")
    if not maps.is_dir():
        maps = data / folder / "predicted_dicenet"

    def drive() -> Drive:
        return labelled(find_label_files([str(maps)]), space or TRAIN_IDS)

    def features() -> Tensor:
        segmenter = Segmenter.load(str(data / "networks" / f"{network}.yaml"), TRAIN_IDS)
        found = (segmenter.segment([read_image(file)], features=True)[0].features for file in files)
        return torch.stack([torch.as_tensor(each) for each in found])

    makers = {
        "label maps": lambda: swept(drive(), OURS),
        "label grid": lambda: LabelGrid().encode_query(drive().seen()),
        "features": features,
        "HOG": lambda: HOG().encode_query(pictured(files).seen()),
    }
    return kept(cached / f"{named}.pt", makers[method])


def middle(vectors: Tensor) -> Tensor:
    """The descriptors of a map: without a sweep."""
    return (
        vectors[:, COLUMNS.index(0)]
        if vectors.ndim == 3 and len(COLUMNS) == vectors.shape[1]
        else vectors
    )
