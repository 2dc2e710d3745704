"""Stored results of VPR-Bench and what its own code prints for them; shared by the tests.

``vpr_bench_corridor.json`` is one of them, CoHOG on the corridor data set (Zaffar et al., IJCV
2021; MIT): best scores, first ten candidates, ground truth, and the figures.
"""

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

VPR_BENCH = Path(__file__).parents[2] / "shared" / "data" / "vprbench"

needs_vpr_bench = pytest.mark.skipif(
    not VPR_BENCH.is_dir(), reason="the VPR-Bench results of ../shared/data are not here"
)


CORRIDOR = VPR_BENCH / "corridor"
needs_corridor = pytest.mark.skipif(
    not CORRIDOR.is_dir(), reason="the corridor images of ../shared/data are not here"
)


class Stored(NamedTuple):
    """What a technique found, and what VPR-Bench prints for it."""

    name: str
    scores: np.ndarray
    candidates: np.ndarray
    truth: list[np.ndarray]
    expected: dict[str, Any]


def frozen_corridor() -> Stored:
    content = json.loads((Path(__file__).parent / "vpr_bench_corridor.json").read_text())
    candidates = np.array(content["candidates"])
    scores = np.full(candidates.shape, -np.inf)
    scores[:, 0] = content["score"]
    truth = [np.arange(first, last + 1) for first, last in content["first_and_last_match"]]
    return Stored("frozen corridor", scores, candidates, truth, content["expected"])


def stored_results() -> Iterator[Stored]:
    expected = json.loads((VPR_BENCH / "expected.json").read_text())
    for data_set, techniques in expected.items():
        for technique, figures in techniques.items():
            stored = np.load(VPR_BENCH / f"{data_set}_{technique}.npz")
            truth = [stored["gt_flat"][a:b].astype(np.int64) for a, b in pairwise(stored["gt_off"])]
            candidates = np.argsort(-stored["sim"], axis=1, kind="stable")[:, :10]
            assert (candidates[:, 0] == stored["match"]).all()
            scores = np.take_along_axis(stored["sim"], candidates, 1).astype(np.float64)
            scores[:, 0] = stored["score"]
            yield Stored(f"{data_set} {technique}", scores, candidates, truth, figures)
