"""Queries, maps and true matches of `how_sure.py`."""

from __future__ import annotations

import random
import zlib
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby, product
from typing import NamedTuple

import _small_network
import numpy as np
import torch
from _described import FEATURES, OURS, Described, channel_of
from _real_pairs import (
    FOREIGN,
    NEW,
    NEW_FOREIGN,
    NONE,
    Frames,
    Truth,
    add_new,
    all_of,
    camvid,
    of,
    pairs,
)
from conditions import METRES, NETWORKS, ROUTES, Drive, city, pictured, pictures_of
from torch import Tensor

from ssrvlad_torch.baselines.channel_methods import EncoderFeatures
from ssrvlad_torch.datasets.synthetic_city import Conditions
from ssrvlad_torch.evaluation.loops import FACING
from ssrvlad_torch.recognition.recognise import references_of
from ssrvlad_torch.recognition.sweep import COLUMNS

METHODS = {
    "label maps": (OURS,),
    "features": (FEATURES,),
    "HOG": ("HOG",),
    "together": (OURS, FEATURES, "HOG"),
}
MOST = 16
"""Cases of a row of the table."""
LOOKED_AT, CITIES, FRESH = 5, range(20), range(60, 68)
"""One real case of so many, and the first cities up to this one, were looked at when the form was
chosen; the table is of the others. Cities that nobody looked at have a table of their own."""
_BACK = Conditions(spacing=2.7, lateral_offset=0.7, seed=3, heading_offset=180.0)
_DENSE, _DENSE_FRAMES, _DENSE_CITIES = Conditions(spacing=0.3, lateral_offset=0.7, seed=4), 800, 10
"""A drive with ten frames to one of the map, of the cities up to this one."""


class Case(NamedTuple):
    """Queries and a map.

    Attributes:
        row: of the table.
        method: of `METHODS`.
        sequences: of the frames of the map.
        rows: of the frames of the map, in the drive from which it was taken.
        truth: rows of that drive that show the place of each query; the map may lack them.
    """

    row: str
    name: str
    method: str
    queries: Frames
    references: Frames
    sequences: list[str]
    rows: Sequence[int]
    truth: Truth

    def scores(self, described: Described) -> Tensor:
        """``(Q, R)``, as `recognise` computes them."""
        queries, references, trust = {}, {}, {}
        for method in METHODS[self.method]:
            here, there = (vectors(described, each, method) for each in self[3:5])
            if there.ndim == 3:
                there = there[:, COLUMNS.index(0)]
            queries[method], references[method] = here.numpy(), there
            trust[method] = channel_of(method).trust
        town = references_of(references, self.sequences, trust)
        return torch.from_numpy(town.compare(queries, True, True)[0])


def vectors(described: Described, frames: Frames, method: str) -> Tensor:
    """The descriptors of frames by a method."""
    runs = (
        (drive, [row for _, row in run]) for drive, run in groupby(frames, lambda each: each[0])
    )
    return torch.cat([described.vectors(drive, method)[rows] for drive, rows in runs])


def cases(described: Described) -> list[Case]:
    """The cases of the table: at most `MOST` of each row, evenly from all that there are."""
    rows: dict[str, list[Case]] = {}
    every = (*real_cases(described), *of_third_network(described), *city_cases(described))
    for case in every:
        rows.setdefault(case.row, []).append(case)
    return [
        some[number * len(some) // min(MOST, len(some))]
        for some in rows.values()
        for number in range(min(MOST, len(some)))
    ]


def real_cases(described: Described) -> Iterator[Case]:
    """Those of real drives that nobody looked at."""
    add_new(described)
    for network, method in product(NETWORKS, METHODS):
        if method == "HOG" and network != NETWORKS[0]:
            continue
        for case in of_method(described, network, method):
            if zlib.crc32((case.row + case.name + method).encode()) % LOOKED_AT:
                yield case


def of_method(described: Described, network: str, method: str) -> Iterator[Case]:
    for name, here, there, truth in pairs(described, network):
        one = partial(case_of, name=name, method=method)
        yield from drives(one, here, there, truth)
        if name.startswith(("uofa", "gardens_walk/day_right")):
            yield from harder(one, here, there, truth)
    for later, earlier in (*FOREIGN, *NEW_FOREIGN):
        here, there = (all_of(described, of(network, each)) for each in (later, earlier))
        part = len(here) // 3
        for name, some in ((later, here), (f"{later}, a third", here[:part])):
            title = f"{name} -> {earlier}, {network}"
            yield case_of("foreign", some, there, [NONE] * len(some), title, method)
    for title, search in camvid(described, network, method):
        queries, references, truth, odd, even = search
        here, there = (
            [(drive, row) for row in rows] for drive, rows in ((queries, odd), (references, even))
        )
        yield case_of("drive", here, there, truth, title, method)
    if method == "label maps" and network != NETWORKS[0]:
        for name, here, there, truth in pairs(described, network):
            other = [(drive.replace(network, NETWORKS[0]), row) for drive, row in there]
            title = f"{name} of {NETWORKS[0]}"
            yield case_of("map of another network", here, other, truth, title, method)


def of_third_network(described: Described) -> Iterator[Case]:
    """Drives by the features of a network to which nothing was fitted, trained on CamVid alone."""
    network = _small_network.NAME
    method = EncoderFeatures(_small_network.segmenter(described))
    for folder in (*dict.fromkeys(each for route in ROUTES.values() for each in route[:2]), *NEW):
        name, files = of(network, folder), pictures_of(described.data, folder)
        described.add(name, files, partial(pictured, files))
        seen = described.drive(name).seen
        described.kept(f"{name} {FEATURES} alike", lambda seen=seen: method.encode_query(seen()))
    for name, here, there, truth in pairs(described, network):
        one = partial(case_of, name=name, method=FEATURES)
        for case in drives(one, here, there, truth):
            yield case._replace(row="third network")
    for later, earlier in (*FOREIGN, *NEW_FOREIGN):
        if "camvid" not in later + earlier:
            here, there = (all_of(described, of(network, each)) for each in (later, earlier))
            for some in (here, here[: len(here) // 3]):
                name = f"{later} -> {earlier}, {network}"
                none = [NONE] * len(some)
                yield case_of("third network, foreign", some, there, none, name, FEATURES)


def case_of(
    row: str,
    here: Frames,
    there: Frames,
    truth: Truth,
    name: str,
    method: str,
    sequences: list[str] | None = None,
    rows: Sequence[int] | None = None,
) -> Case:
    """Of a map of all frames ``there``, or of some rows of them."""
    rows = range(len(there)) if rows is None else rows
    names = sequences or ["map"] * len(there)
    known = [there[each] for each in rows], [names[each] for each in rows]
    return Case(row, name, method, here, *known, rows, truth)


def drives(one: partial[Case], here: Frames, there: Frames, truth: Truth) -> Iterator[Case]:
    """The whole drive, its halves, and half of the map."""
    yield one("drive", here, there, truth)
    middle, half = len(here) // 2, len(there) // 2
    if middle >= 30:
        for part in (slice(0, middle), slice(middle, None)):
            yield one("half of a drive", here[part], there, truth[part])
        if half >= 30:
            yield one("half of the map", here, there, truth, rows=range(half))


def harder(one: partial[Case], here: Frames, there: Frames, truth: Truth) -> Iterator[Case]:
    """What breaks a drive, or the map."""

    def asked(row: str, order: Iterable[int]) -> Case:
        order = list(order)
        return one(row, [here[each] for each in order], there, [truth[each] for each in order])

    count, chance = len(here), random.Random(str(here[0]))
    kept = [row for row in range(len(there)) if row // 15 % 2 == 0]
    yield one("holes of 15 rows", here, there, truth, rows=kept)
    for streams in (2, 3, 4, 6):
        row = "two streams in turn" if streams == 2 else "3, 4, 6 streams in turn"
        yield asked(row, in_turn(count, streams))
    yield asked("stops", stops(count, (20, 80), 30))
    yield asked("queue", in_queue(count, 1, chance))
    for place, order in ((1, (0, count)), (count - 2, (count, 0))):
        parked = [chance.randrange(place - 1, place + 2) for _ in range(60)]
        yield asked("parked at an end", [*range(order[0]), *parked, *range(order[1])])
    yield asked("backwards", reversed(range(count)))
    for step in (2, 3):
        yield asked("every 2nd, 3rd query", range(0, count, step))
    for some in (3, 10, 30, 100):
        yield asked("random frames", chance.sample(range(count), min(some, count)))
    yield asked("one picture", [chance.randrange(count)])
    twice = [row for row in range(len(there)) for _ in range(2)]
    yield one("duplicates in the map", here, there, truth, rows=twice)
    for size in (5, 12, 31, 60):
        first = chance.randrange(len(there) - size)
        rows = range(first, first + size)
        shown = [query for query in range(count) if size <= 12 or np.isin(truth[query], rows).any()]
        queries, true = [here[each] for each in shown], [truth[each] for each in shown]
        yield one("maps of 5 to 60 rows", queries, there, true, rows=rows)


def city_cases(described: Described, seeds: Iterable[int] = CITIES[6:]) -> Iterator[Case]:
    """Those of cities by their seeds."""
    for seed in seeds:
        described.added[f"city {seed} back"] = partial(way_back, seed)
        described.added[f"city {seed} dense"] = partial(city, seed, _DENSE, _DENSE_FRAMES)
        others = [all_of(described, f"city {(seed + n) % 20} reference") for n in range(1, 6)]
        yield from in_city(described, seed, others)
        if seed < _DENSE_CITIES:
            yield from dense(described, seed)


def in_city(described: Described, seed: int, others: Sequence[Frames]) -> Iterator[Case]:
    there, easy, hard, back = (
        all_of(described, f"city {seed} {drive}")
        for drive in ("reference", "clean 0", "all together 0", "back")
    )
    one = partial(case_of, name=f"city {seed}", method="label maps")
    known = [*there, *(frame for other in others for frame in other)]
    names = [drive for drive, _ in known]
    for here in (easy, hard):
        truth = facing(described, here, there)
        yield one("city", here, there, truth)
        yield one("city, foreign", here, others[0], [NONE] * len(here))
        yield one("city, foreign, 30", here[:30], others[0], [NONE] * 30)
        yield one("city, half of the map", here, there, truth, rows=range(len(there) // 2))
        kept = [row for row in range(len(there)) if row // 15 % 2 == 0]
        yield one("city, holes of 15 rows", here, there, truth, rows=kept)
        yield one("city, map of 600", here, known, truth, sequences=names)
        for some in (1, 3, 10, 30):
            order = random.Random(seed).sample(range(len(here)), some)
            row = "city, one picture" if some == 1 else "city, random frames"
            yield one(row, [here[n] for n in order], there, [truth[n] for n in order])
    truth = facing(described, easy, there)
    for streams in (3, 4, 6):
        order = in_turn(len(easy), streams)
        queries, true = [easy[n] for n in order], [truth[n] for n in order]
        yield one("city, 3, 4, 6 streams in turn", queries, there, true)
    order = stops(len(easy), (30,), 40)
    yield one("city, stops", [easy[n] for n in order], there, [truth[n] for n in order])
    turned = [*easy[:50], *back[50:]]
    yield one("city, U-turn", turned, there, facing(described, turned, there))
    yield one("city, way back alone", easy, back, facing(described, easy, back))
    both, names = [*there, *back], ["map"] * len(there) + ["back"] * len(back)
    rows = [*range(50), *range(len(there), len(both))]
    true = facing(described, easy, both)
    yield one("city, half of the map and way back", easy, both, true, sequences=names, rows=rows)


def dense(described: Described, seed: int) -> Iterator[Case]:
    """A drive with ten frames to one of the map, and one whose speed falls to a tenth."""
    here, there = (all_of(described, f"city {seed} {drive}") for drive in ("dense", "reference"))
    one = partial(case_of, name=f"city {seed}", method="label maps")
    row = "city, ten times denser, or a queue"
    for some in (here, [here[n] for n in in_queue(len(here), 9, random.Random(seed))]):
        yield one(row, some, there, facing(described, some, there))


def in_turn(count: int, streams: int) -> list[int]:
    """The parts of a drive, a frame of each in turn."""
    length = count // streams
    return [part * length + frame for frame in range(length) for part in range(streams)]


def stops(count: int, at: Sequence[int], frames: int) -> list[int]:
    """A drive that stands for some frames."""
    return sorted([*range(count), *(min(stop, count - 1) for stop in at for _ in range(frames))])


def in_queue(count: int, step: int, chance: random.Random) -> list[int]:
    """Every so many frames of a drive; for 80 of them it hardly moves."""
    at = count // 3 // step * step
    slow = [at := at + max(1, step // 3) * (chance.random() < 0.25) for _ in range(80)]
    return [*range(0, slow[0], step), *slow, *range(slow[-1], count, step)]


def facing(described: Described, here: Frames, there: Frames) -> list[np.ndarray]:
    """Frames of a city within `METRES` that look in the same direction."""
    mine, known = (
        np.array([described.about(drive)[1][row] for drive, row in frames])
        for frames in (here, there)
    )
    x, y, turn = (mine[:, None] - known).transpose(2, 0, 1)
    same = (np.hypot(x, y) <= METRES) & (np.cos(turn) > np.cos(FACING))
    return [np.flatnonzero(each) for each in same]


def way_back(seed: int) -> Drive:
    """The street of a city in the other direction."""
    drive = city(seed, _BACK)
    return Drive(drive.frames, drive.poses[::-1], drive.maps[::-1].copy(), drive.labels_as)
