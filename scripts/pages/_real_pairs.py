"""Sequences of real drives, those through one place, and their true matches."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from _described import Described
from conditions import (
    CAMVID_CONDITIONS,
    NETWORKS,
    ROUTES,
    Drive,
    Search,
    near_rows,
    pictured,
    pictures_of,
)

FOREIGN = (
    ("uofa/evening", "gardens_walk/day_left"),
    ("gardens_walk/day_left", "uofa/day"),
    ("gardens_walk/night_right", "uofa/evening"),
    ("camvid/0016E5", "uofa/day"),
    ("uofa/day", "camvid/0016E5"),
    ("camvid/0001TP", "camvid/0016E5"),
)
NEW_FOREIGN = (
    ("cmu_schenley/oct2010_c1", "uofa/day"),
    ("nordland/summer", "cmu_schenley/apr2011_c1"),
)
DRIVES = ("0001TP", "0016E5")
NEW = ("cmu_schenley/apr2011_c1", "cmu_schenley/oct2010_c1", "cmu_schenley/jul2011_c1")
NEW += ("nordland/summer", "nordland/winter")
"""Drives that come as pictures alone."""
NONE = np.zeros(0, int)
Frames = list[tuple[str, int]]
"""Frames by their drives and their rows in them."""
Truth = Sequence[np.ndarray]


def all_of(described: Described, drive: str) -> Frames:
    return [(drive, row) for row in range(len(described.about(drive)[0]))]


def of(network: str, folder: str) -> str:
    """The name of a drive; the pictures of all networks are the same."""
    return f"real {network or NETWORKS[0]} {folder}"


def add_new(described: Described) -> None:
    """The drives that come as pictures alone."""
    for network, folder in product(NETWORKS, NEW):
        files = pictures_of(described.data, folder)
        make = partial(_pictured, described, network, folder)
        described.add(of(network, folder), files, make)


def _pictured(described: Described, network: str, folder: str) -> Drive:
    return pictured(pictures_of(described.data, folder), described.segmenter(network))


def pairs(described: Described, network: str) -> Iterator[tuple[str, Frames, Frames, Truth]]:
    """Drives through one place: a name, queries, map and true matches."""

    def pair(later: str, earlier: str, truth: Truth) -> tuple[str, Frames, Frames, Truth]:
        here, there = (all_of(described, of(network, each)) for each in (later, earlier))
        return f"{later} -> {earlier}, {network}", here, there, truth[: len(here)]

    for first, second, reach in ROUTES.values():
        size = len(described.about(of(network, first))[0])
        for later, earlier in ((first, second), (second, first)):
            yield pair(later, earlier, near_rows(size, size, reach))
    for later, earlier, truth in new_pairs(described, network):
        yield pair(later, earlier, truth)


def new_pairs(described: Described, network: str) -> Iterator[tuple[str, str, Truth]]:
    """Drives of `NEW` through one place: queries, map and true matches."""
    apr, october, july, summer, winter = NEW
    count = {each: len(described.about(of(network, each))[0]) for each in NEW}
    for later, table in ((october, "pairs_oct_c1.csv"), (july, "pairs_jul_c1.csv")):
        yield later, apr, given(described, table, count[later], count[apr])
    truth = given(described, "pairs_oct_c1.csv", count[october], count[apr])
    other = [[q for q, true in enumerate(truth) if row in true] for row in range(count[apr])]
    yield apr, october, [np.array(each, int) for each in other]
    truth = near_rows(count[winter], count[summer], 2)
    yield winter, summer, [true if n < 20 else NONE for n, true in enumerate(truth)]


def given(described: Described, table: str, queries: int, references: int) -> list[np.ndarray]:
    """True matches of CMU Seasons, by a table."""
    truth = [NONE] * queries
    with (described.data / "cmu_schenley" / table).open() as file:
        for line in csv.DictReader(file):
            query, row, reach = (int(each) for each in line.values())
            truth[query] = np.arange(max(0, row - reach), min(references, row + reach + 1))
    return truth


class Searched(NamedTuple):
    """A search by its name."""

    name: str
    search: Search


def camvid(described: Described, network: str, method: str) -> Iterator[Searched]:
    """Odd frames of a drive against even ones; label maps of several kinds, once."""
    if method == "label maps":
        if network == NETWORKS[0]:
            yield from camvid_cases(described)
        return
    for case in camvid_cases(described):
        if case.name.endswith("espnetv2 -> espnetv2"):
            drive = case.name.partition(",")[0]
            folder = of(network, f"camvid/{drive}")
            search = case.search._replace(queries=folder, references=folder)
            yield Searched(f"{drive}, {network}", search)


def camvid_cases(described: Described) -> Iterator[Searched]:
    """Odd frames of a drive by one kind of label maps against even ones by another."""
    same = json.loads((described.data / "camvid" / "same_place_odd_even.json").read_text())
    for drive in DRIVES:
        frames, _ = described.about(of("labels", f"camvid/{drive}"))
        odd, even = (list(range(start, len(frames), 2)) for start in (1, 0))
        at = {frames[row]: number for number, row in enumerate(even)}
        truth = [np.array([at[frame] for frame in same[frames[row]]]) for row in odd]
        for name, kinds in CAMVID_CONDITIONS.items():
            folders = [of(kind.removeprefix("predicted_"), f"camvid/{drive}") for kind in kinds]
            yield Searched(f"{drive}, {name}", Search(*folders, truth, odd, even))
