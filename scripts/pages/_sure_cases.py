"""Queries and maps of `how_sure.py` and `_loops_real.py`, with their true matches."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from _described import FEATURES, OURS, Described
from conditions import CAMVID_CONDITIONS, METRES, NETWORKS, ROUTES, Search, near_rows

from ssrvlad_torch.evaluation.ground_truth import from_poses

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
METHODS = {
    **{"label maps": OURS, "features": FEATURES, "HOG": "HOG", "label grid": "label grid"},
    "fused": "without HOG",
}
"""Methods of `_described.py` by their names here."""

RUNS = [
    (method, network) for method in METHODS for network in ([""] if method == "HOG" else NETWORKS)
]


class Case(NamedTuple):
    """A search by a method; the groups are those of the page."""

    group: str
    name: str
    method: str
    search: Search


def cases(described: Described) -> Iterator[Case]:
    """All cases."""
    for method, network in RUNS:
        for first, second, reach in ROUTES.values():
            for queries, references in ((first, second), (second, first)):
                here, there = of(network, queries), of(network, references)
                frames = len(described.about(there)[0])
                truth = near_rows(len(described.about(here)[0]), frames, reach)
                title = f"{queries} -> {references}, {network}"
                yield Case("real", title, method, Search(here, there, truth))
                if (queries, references) == (first, second):
                    left = [true[true < frames // 2] for true in truth]
                    search = Search(here, there, left, None, list(range(frames // 2)))
                    yield Case("half map", title, method, search)
        for queries, references in FOREIGN:
            here, there = of(network, queries), of(network, references)
            truth = [np.zeros(0, int)] * len(described.about(here)[0])
            title = f"{queries} -> {references}, {network}"
            yield Case("foreign", title, method, Search(here, there, truth))
    yield from camvid_cases(described)
    for drive, (method, network) in product(DRIVES, RUNS):
        if method != "label maps":
            case = next(case for case in camvid_cases(described) if case.name.startswith(drive))
            folder = of(network, f"camvid/{drive}")
            search = case.search._replace(queries=folder, references=folder)
            yield Case("real", f"{drive}, {network}", method, search)
    for seed, name in product(range(3), STREETS):
        here, there = f"city {seed} {name} 0", f"city {seed} reference"
        poses = (described.about(drive)[1] for drive in (here, there))
        search = Search(here, there, from_poses(*poses, METRES))
        yield Case("city", f"city {seed}, {name}", "label maps", search)


def of(network: str, folder: str) -> str:
    """The name of a drive; the pictures of all networks are the same."""
    return f"real {network or NETWORKS[0]} {folder}"


def camvid_cases(described: Described) -> Iterator[Case]:
    """Odd frames of a drive by one kind of label maps against even ones by another."""
    same = json.loads((described.data / "camvid" / "same_place_odd_even.json").read_text())
    for drive in DRIVES:
        frames, _ = described.about(of("labels", f"camvid/{drive}"))
        odd, even = (list(range(start, len(frames), 2)) for start in (1, 0))
        at = {frames[row]: number for number, row in enumerate(even)}
        truth = [np.array([at[frame] for frame in same[frames[row]]]) for row in odd]
        for name, kinds in CAMVID_CONDITIONS.items():
            drives = [of(kind.removeprefix("predicted_"), f"camvid/{drive}") for kind in kinds]
            search = Search(*drives, truth, odd, even)
            yield Case("real", f"{drive}, {name}", "label maps", search)
