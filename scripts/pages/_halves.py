"""The conditions of `shape.py` and `ablate.py`, each with two halves: one on which settings were
chosen, and another."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _described import NETWORKS, REAL
from _trials import Cache
from conditions import (
    CITY_CONDITIONS,
    METRES,
    SPACES,
    Describe,
    Drive,
    camvid,
    city,
    every_other,
)
from torch import Tensor

from ssrvlad_torch import SSRVLADConfig, follow, standardise
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers, from_poses
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.taxonomy import label_space

ROUTES = {name: route for routes in REAL.values() for name, route in routes.items()}
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

WAYS = ("raw", "standardised", "followed")

GROUPS_IN_WORDS = f"""\
- *real*: {len(ROUTES)} pairs of traverses (a campus by day and in the evening; a walk on the left,
  on the right and at night), with the label maps of {len(NETWORKS)} networks trained on other
  data.
- *CamVid*: odd frames of a drive are queries, even frames are references; hand-made labels and the
  outputs of two networks. All frames of a stop of the car are one place.
- *city*: {len(SEEDS[0])} synthetic city per half; {", ".join(STREETS)}. A true match is within
  {METRES:g} m.
"""


class Search(NamedTuple):
    """Queries, references and true matches."""

    queries: Drive
    references: Drive
    truth: list[np.ndarray]


def measured(
    ways: dict[str, Describe], data: Path, cache: Path
) -> dict[str, dict[str, list[float]]]:
    """RecallRate@1 by each of `WAYS`, for every way to describe, by group and half; results are
    cached."""
    kept, found = Cache(cache), {}
    parts = {"real": (real, ROUTES), "CamVid": (in_camvid, CAMVID), "city": (in_city, STREETS)}
    for name, describe in ways.items():
        found[name] = {
            f"{group}, {HALVES[half]}": kept.get(
                (name, SSRVLADConfig().fingerprint, searches, SEEDS, half),
                partial(_rates, describe, make(data, half)),
            )
            for group, (make, searches) in parts.items()
            for half in range(2)
        }
        print(name, found[name], flush=True)
    return found


def _rates(describe: Describe, searches: Iterable[Search]) -> list[float]:
    """The mean over searches; a drive of several searches is described once."""
    known: dict[int, Tensor] = {}

    def of(drive: Drive) -> Tensor:
        if id(drive) not in known:
            known[id(drive)] = describe(drive)
        return known[id(drive)]

    rates: list[float] = np.mean([rates_of(search, of) for search in searches], 0).tolist()
    return rates


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
    """Half of a real traverse, with the label maps of a network."""
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
