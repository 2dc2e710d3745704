"""What following does to queries that are no sequence: frames drawn from a drive at random."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from _described import FUSED, OURS, TOGETHER, Condition, Described, all_conditions
from _markdown import head_row, interval, row

from ssrvlad_torch.recognition.recognise import NO_SEQUENCE, Recognised, Steps, recognise

LENGTHS = (10, 30)
DRAWS = 10
DATASETS = ("UofA", "Gardens Point", "CamVid")
WAYS = ("frames at random", "consecutive frames")


def no_sequence(described: Described) -> Iterator[str]:
    """The table, of conditions with label maps of one network."""
    yield from head_row("method", "data set", "queries", "followed", "`--follow no`", "default")
    conditions = [c for c in all_conditions(described, seeds=()) if c.dataset in DATASETS]
    for method in (OURS, TOGETHER):
        for dataset in DATASETS:
            suited = [c for c in conditions if c.dataset == dataset and c.suits(method)]
            for way in WAYS if suited else ():
                for length in LENGTHS:
                    results = [_draw(described, c, method, way, length) for c in suited]
                    followed, *rates = np.concatenate(results).T
                    cells = (interval(rate.mean(), _ends(rate)) for rate in rates)
                    name = f"{length} {way}"
                    yield row(method, dataset, name, f"{followed.mean():.2f}", *cells)


def _draw(
    described: Described, condition: Condition, method: str, way: str, length: int
) -> np.ndarray:
    """``(DRAWS, 3)``: whether each was followed, RecallRate@1 of single frames and default."""
    [search] = condition.searches
    members = FUSED.get(method, {})
    queries, references = described.pair(search, OURS if members else method)
    extra = {name: described.pair(search, member) for name, member in members.items()}
    names = described.sequences(search)[1]
    random = np.random.default_rng(length)

    def recognised(rows: np.ndarray, steps: Steps) -> Recognised:
        drawn = torch.from_numpy(rows)
        others = {name: (here[drawn], there) for name, (here, there) in extra.items()}
        sequence = ["drawn"] * len(rows)
        return recognise(queries[drawn], references, sequence, names, steps, 1, extra=others)

    results = []
    for _ in range(DRAWS):
        if way == WAYS[0]:
            rows = random.choice(len(queries), length, replace=False)
        else:
            rows = random.integers(len(queries) - length) + np.arange(length)
        alone, default = (recognised(rows, steps) for steps in (Steps(follow=None), Steps()))
        followed = default.used["follow"]["drawn"] != NO_SEQUENCE
        results.append((followed, *(_rate(each, rows, search.truth) for each in (alone, default))))
    return np.array(results, float)


def _rate(found: Recognised, rows: np.ndarray, truth: list[np.ndarray]) -> float:
    first = found.matches.indices[:, 0].tolist()
    return float(np.mean([row in truth[query] for query, row in zip(rows, first, strict=True)]))


def _ends(rates: np.ndarray) -> tuple[float, float]:
    """The ends of the 95 % bootstrap interval of the mean."""
    drawn = np.random.default_rng(0).choice(rates, (1000, len(rates))).mean(1)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)
