"""Results that VPR-Bench publishes with its data sets, as trials."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from _trials import TOP, Trial

TECHNIQUES = {"CoHOG": "CoHOG", "Region-VLAD": "RegionVLAD", "NetVLAD": "NetVLAD"}
"""VPR-Bench's names of techniques in file names, by our names."""


def stored_trials(corridor: Path) -> dict[str, Trial]:
    """Trials in the files ``<data set>_<technique>.npz`` beside a data set, by our names.

    A file holds ``sim (Q, R)``, and the true matches of query ``i`` as
    ``gt_flat[gt_off[i] : gt_off[i + 1]]``.
    """
    trials = {}
    for ours, theirs in TECHNIQUES.items():
        file = corridor.parent / f"{corridor.name}_{theirs}.npz"
        if file.exists():
            with np.load(file, allow_pickle=False) as stored:
                trials[ours] = _trial(stored["sim"], stored["gt_flat"], stored["gt_off"])
    return trials


def _trial(similarity: np.ndarray, flat: np.ndarray, offsets: np.ndarray) -> Trial:
    ranked = np.argsort(-similarity, axis=1, kind="stable")[:, :TOP]
    scores = np.take_along_axis(similarity, ranked, axis=1).astype(np.float32)
    lacking = ((0, 0), (0, TOP - ranked.shape[1]))
    ranked = np.pad(ranked, lacking, constant_values=-1)
    scores = np.pad(scores, lacking, constant_values=-np.inf)
    truth = [flat[begin:end] for begin, end in pairwise(offsets)]
    return Trial(scores, ranked, truth, similarity.shape[1], float("nan"))
