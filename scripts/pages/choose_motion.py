#!/usr/bin/env python3
"""Chooses the settings of `recognition.motion.Motion`, and writes docs/motion.csv.

    .venv/bin/python scripts/pages/choose_motion.py --data ../shared/data

Each setting is measured on four data sets (CamVid, UofA, Gardens Point, and two cities that no
page measures), with the descriptors of `default`, online and offline, in three ways:

- RecallRate@1 of the drives as they are,
- the same of drives cut up: with a stop, a stretch at double speed, two jumps and a stretch back,
- the area under precision over recall, by `Places.near`, where the map has only its first half.

The score of a setting on a data set is the mean of the six figures. The setting for a data set is
the best on the *other* three: nothing is tuned on what it is reported on. What the package has is
the best on all four. About ten minutes on one thread, once the descriptions are made.
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _described import NETWORKS, Described, all_conditions
from _markdown import write
from torch import Tensor

from ssrvlad_torch.recognition.follow import follow, runs
from ssrvlad_torch.recognition.motion import Motion
from ssrvlad_torch.recognition.standardise import standardise
from ssrvlad_torch.recognition.sweep import narrowed, score

METHOD = "SSR-VLAD, default"
SEEDS = (10, 11)
GRID = {"weight": (0.2, 0.3, 0.45), "level": (0.5,), "change": (0.01, 0.02, 0.05)}
MODES = ("online", "offline")
Setting = dict[str, float]
Figures = dict[str, dict[str, float]]
"""By data set, the six figures."""

WAYS = ("as they are", "cut up", "half of the map")


class Problem(NamedTuple):
    """Scores ``(Q, R)`` of a drive, which pairs are true, and the sequence of each row."""

    scores: Tensor
    true: Tensor
    sequences: list[str]

    def cut_up(self) -> Problem:
        """With a stop, a stretch at double speed, two jumps and a stretch back."""

        def at(first: float, last: float, step: int = 1) -> range:
            return range(int(first * len(self.scores)), int(last * len(self.scores)), step)

        stop = [at(0, 0.25)[-1]] * (len(self.scores) // 10)
        parts = (at(0, 0.25), stop, at(0.25, 0.55, 2), at(0.8, 1), at(0.3, 0.5), at(0.7, 0.5, -1))
        order = [row for part in parts for row in part]
        return self._replace(scores=self.scores[order], true=self.true[order])

    def half(self) -> Problem:
        """Against the first half of the map."""
        rows = self.scores.shape[1] // 2
        return Problem(self.scores[:, :rows], self.true[:, :rows], self.sequences[:rows])


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, required=True)
    arguments.add_argument("--cache", type=Path, default=Path(".cache/described"))
    arguments.add_argument("--output", type=Path, default=Path("docs/motion.csv"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    problems = all_problems(Described(options.data, options.cache))
    settings = [
        dict(zip(GRID, values, strict=True)) for values in itertools.product(*GRID.values())
    ]
    table = []
    for setting in settings:
        motion = Motion(**setting)
        table.append({name: figures(of, motion) for name, of in problems.items()})
        print(
            setting, {name: round(mean(found), 4) for name, found in table[-1].items()}, flush=True
        )
    write(options.output, to_csv(settings, table))


def all_problems(described: Described) -> dict[str, list[Problem]]:
    problems: dict[str, list[Problem]] = {}
    for condition in all_conditions(described, SEEDS, NETWORKS):
        for search in condition.searches:
            queries, references = described.pair(search, METHOD)
            here, there = described.sequences(search)
            known = standardise(references, there)
            true = torch.zeros(len(queries), len(known), dtype=torch.bool)
            for query, rows in enumerate(search.truth):
                true[query, rows] = True
            for run in runs(here):
                part = slice(run.start, run.stop)
                scores = score(narrowed(queries[part], known)[0], known)
                problem = Problem(scores, true[part], there)
                problems.setdefault(condition.dataset, []).append(problem)
    return problems


def figures(problems: Sequence[Problem], motion: Motion) -> dict[str, float]:
    """The six figures of a setting on a data set."""
    found: dict[str, list[float]] = {}
    for problem in problems:
        parts = (problem, problem.cut_up(), problem.half())
        for mode, (way, part) in itertools.product(MODES, zip(WAYS, parts, strict=True)):
            places = follow(part.scores, part.sequences, mode=mode, motion=motion)
            right = part.true.gather(1, places.indices[:, :1])[:, 0]
            known = part.true.any(1)
            rate = float(right[known].double().mean())
            area = average_precision(places.near, right, int(known.sum()))
            found.setdefault(f"{way}, {mode}", []).append(rate if way != WAYS[2] else area)
    return {name: float(np.mean(values)) for name, values in found.items()}


def average_precision(near: Tensor, right: Tensor, known: int) -> float:
    ranked = right[near.argsort(descending=True)].double()
    precision = ranked.cumsum(0) / torch.arange(1, len(ranked) + 1)
    return float((precision * ranked).sum() / max(1, known))


def mean(found: Mapping[str, float]) -> float:
    return float(np.mean(list(found.values())))


def chosen(table: Sequence[Figures], left_out: str | None) -> int:
    """The best setting by the data sets but one."""
    scores = [np.mean([mean(of) for name, of in row.items() if name != left_out]) for row in table]
    return int(np.argmax(scores))


def to_csv(
    settings: Sequence[dict[str, float]], table: Sequence[dict[str, dict[str, float]]]
) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    names = list(next(iter(table[0].values())))
    rows.writerow(["data set", "chosen on", *GRID, *names])
    for line in lines(settings, table):
        rows.writerow(line)
    return text.getvalue()


def lines(settings: Sequence[Setting], table: Sequence[Figures]) -> Iterator[list[str]]:
    whole = chosen(table, None)
    for name in table[0]:
        for told, number in (("the others", chosen(table, name)), ("all", whole)):
            found = table[number][name].values()
            values = [f"{value:g}" for value in settings[number].values()]
            yield [name, told, *values, *(f"{value:.4f}" for value in found)]


if __name__ == "__main__":
    main()
