"""Loops between real drives, and where they fail: tables of `loops.py`.

Frames come from the folders of ``--data`` as in `how_sure.py`. The frames of the map come first,
then the queries: in one sequence without stamps, or after an hour; or as two sequences.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _described import FEATURES, OURS, Described, channel_of
from _markdown import Page, head_row, row, write_csv
from _real_pairs import FOREIGN, camvid_cases, of
from _tours import CONDITIONS, swept
from conditions import NETWORKS, ROUTES, near_rows
from torch import Tensor

from ssrvlad_torch import LoopDetector
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.synthetic_city import STRAIGHT, SyntheticCity
from ssrvlad_torch.loops.detector import COLUMNS
from ssrvlad_torch.recognition.sweep import COLUMNS as ALL_COLUMNS

ALONE: tuple[str, ...] = ()
WITH_HOG = (FEATURES, "HOG")
ONE_STREAM = {"label maps": ALONE, "features and HOG": WITH_HOG}
ONE_NAME, AFTER_AN_HOUR, TWO_NAMES = "one name", "after an hour", "two names"
WAYS = (ONE_NAME, AFTER_AN_HOUR, TWO_NAMES)
LATER = 3600.0
COUNTS = ("wrong", "elsewhere")
NEAR = 3
STREETS, CUT = range(300, 308), 10
HOLES = ((0.2, 0.4), (0.4, 0.6), (0.6, 0.8))
"""Parts of the first drive that are missing, one at a time."""


class Drive(NamedTuple):
    """A drive by label maps ``(N, S, 480)``, and by the methods beside."""

    vectors: Tensor
    beside: dict[str, Tensor]


class Pair(NamedTuple):
    """Two drives, and for each frame of the second its rows of the first."""

    name: str
    first: Drive
    second: Drive
    truth: Sequence[np.ndarray]


class Outcome(NamedTuple):
    """For each frame of the second drive, whether it closes a right loop; wrong loops of all
    frames, and those that lead elsewhere."""

    right: np.ndarray
    wrong: int
    elsewhere: int


def real_drives(page: Page, data: Path, cached: Path) -> None:
    """The tables of real drives, and of streams with nothing to find."""
    described = Described(data, cached, shorter_side=None)
    chosen, checks = conditions(described)
    write_csv(page.output.parent / "loops-pairs.csv", one_stream([*chosen, *checks]))
    page.table("loops-leaving", left([*chosen, *checks]))
    write_csv(page.output.parent / "loops-nothing.csv", nowhere(described))


def nowhere(described: Described) -> Iterator[str]:
    """Rows of foreign places and of estates."""
    yield from head_row("stream", "streams", "frames", "loops", "wrong", "in streams")
    for (name, names), way in product(ONE_STREAM.items(), (ONE_NAME, TWO_NAMES)):
        yield nothing(f"foreign places, {way}, {name}", foreign(described), names, way)
    for name in CONDITIONS:
        streets = [estate(described, seed, name) for seed in STREETS]
        yield nothing(f"estate, {name}", streets, ALONE)


def one_stream(pairs: Sequence[Pair]) -> Iterator[str]:
    """Recall of pairs by each method and way to name frames, and wrong loops that lead
    elsewhere."""
    yield from head_row("drives", *(f"{m}: {way}" for m in ONE_STREAM for way in WAYS))
    for pair in pairs:
        cells = []
        for beside, way in product(ONE_STREAM.values(), WAYS):
            if not set(beside) <= set(pair.first.beside):
                cells.append("")
                continue
            outcome = detect(pair, beside, way)
            wrong = f", {outcome.elsewhere} elsewhere" if outcome.elsewhere else ""
            cells.append(f"{outcome.right.mean():.2f}{wrong}")
        yield row(pair.name, *cells)
        print(pair.name, *cells, flush=True)


def left(pairs: Sequence[Pair]) -> Iterator[str]:
    """Rows on drives that leave the first one, where a part of it is missing, and come back."""
    yield from head_row("stream", "streams", "frames", "recall", "loops", *COUNTS)
    for (name, names), way in product(ONE_STREAM.items(), (ONE_NAME, TWO_NAMES)):
        real = [pair for pair in pairs if set(WITH_HOG) <= set(pair.first.beside)]
        cut = [without(pair, *hole) for pair, hole in product(real, HOLES)]
        outcomes = [detect(pair, names, way) for pair in cut]
        places = sum(len(rows) > 0 for pair in cut for rows in pair.truth)
        right, wrong = (sum(int(np.sum(outcome[of])) for outcome in outcomes) for of in (0, 1))
        elsewhere = sum(outcome.elsewhere for outcome in outcomes)
        counts = str(right + wrong), str(wrong), str(elsewhere)
        yield row(f"{name}: {way}", str(len(cut)), str(places), f"{right / places:.2f}", *counts)
        print(name, way, *counts, flush=True)


def without(pair: Pair, begin: float, end: float) -> Pair:
    """A pair without a part of the first drive."""
    count = len(pair.first.vectors)
    remaining = np.r_[: int(begin * count), int(end * count) : count]
    new = np.full(count, -1)
    new[remaining] = np.arange(len(remaining))
    beside = {name: vectors[remaining] for name, vectors in pair.first.beside.items()}
    inside = (rows[(rows >= 0) & (rows < count)] for rows in map(np.asarray, pair.truth))
    truth = [new[rows][new[rows] >= 0] for rows in inside]
    return pair._replace(first=Drive(pair.first.vectors[remaining], beside), truth=truth)


def nothing(name: str, pairs: Sequence[Pair], beside: tuple[str, ...], way: str = TWO_NAMES) -> str:
    """A row on streams that should close no loop."""
    outcomes = [
        detect(pair, beside, way) for pair in pairs if set(beside) <= set(pair.first.beside)
    ]
    wrong = [outcome.wrong for outcome in outcomes]
    loops = sum(wrong) + sum(int(outcome.right.sum()) for outcome in outcomes)
    frames = sum(len(pair.second.vectors) for pair in pairs)
    print(name, wrong, flush=True)
    counts = len(outcomes), frames, loops, sum(wrong), np.count_nonzero(wrong)
    return row(name, *map(str, counts))


def detect(pair: Pair, beside: tuple[str, ...], way: str = TWO_NAMES) -> Outcome:
    """Runs a detector over the first drive and then over the second."""
    loops = LoopDetector(channels=[channel_of(name) for name in beside])
    right, wrong, elsewhere = np.zeros(len(pair.second.vectors), bool), 0, 0
    for drive, (vectors, others) in (("first", pair.first), ("second", pair.second)):
        sequence = drive if way == TWO_NAMES else "stream"
        start = LATER * (drive == "second") if way == AFTER_AN_HOUR else np.nan
        for number, vector in enumerate(vectors):
            here = {"ssr-vlad": vector}
            here |= {channel_of(name).column.name: others[name][number] for name in beside}
            record = FrameRecord(sequence, f"{drive} {number}", stamp=start + number / 3)
            result = loops.observe(record, here)
            if not result.accepted:
                continue
            there, place = str(result.candidate).rpartition("/")[2].split()
            near = [len(vectors)]
            if (drive, there) == ("second", "first"):
                near = [abs(int(place) - true) for true in pair.truth[number]] or near
            right[number] |= min(near) == 0
            wrong += min(near) > 0
            elsewhere += min(near) > NEAR
    return Outcome(right, wrong, elsewhere)


def conditions(described: Described) -> tuple[list[Pair], list[Pair]]:
    """The pairs of the first table, and those that check."""
    chosen: list[Pair] = []
    checks: list[Pair] = []
    for network, (name, (later, earlier, reach)) in product(NETWORKS, ROUTES.items()):
        first, second = (drive(described, of(network, folder)) for folder in (earlier, later))
        truth = near_rows(len(second.vectors), len(first.vectors), reach)
        back = " -> ".join(reversed(name.split(" -> ")))
        chosen.append(Pair(f"{name}, {network}", first, second, truth))
        checks.append(Pair(f"{back}, {network}", second, first, truth))
    for case in camvid_cases(described):
        queries, references, truth, odd, even = case.search
        here = of_anchors(described.vectors(queries, OURS)[odd])
        there = of_anchors(described.vectors(references, OURS)[even])
        kept_in = chosen if case.name.endswith("-> labels") else checks
        kept_in.append(Pair(case.name, Drive(there, {}), Drive(here, {}), truth))
    return chosen, checks


def drive(described: Described, name: str) -> Drive:
    labels, *beside = (described.vectors(name, method) for method in (OURS, *WITH_HOG))
    return Drive(of_anchors(labels), dict(zip(WITH_HOG, beside, strict=True)))


def of_anchors(swept: Tensor) -> Tensor:
    """``(N, S, 480)``, from the anchors of a detector."""
    return swept[:, [ALL_COLUMNS.index(column) for column in COLUMNS]]


def foreign(described: Described) -> list[Pair]:
    pairs = []
    for network, (later, earlier) in product(NETWORKS, FOREIGN):
        one, two = (drive(described, of(network, folder)) for folder in (earlier, later))
        truth = [np.zeros(0, int)] * len(two.vectors)
        pairs.append(Pair(f"{earlier}, {later}", one, two, truth))
    return pairs


def estate(described: Described, seed: int, condition: str) -> Pair:
    """A drive through an estate; without a second one."""
    drive = partial(SyntheticCity(seed, (0,)).traverse, 130, CONDITIONS[condition])
    size, turns = (60, 80), [STRAIGHT] * 5
    vectors = described.kept(
        f"estate {seed} {condition}", lambda: swept(drive(size=size, turns=turns))
    )
    truth = [np.zeros(0, int)] * len(vectors)
    return Pair(f"estate {seed}", Drive(vectors[:0], {}), Drive(vectors, {}), truth)
