"""How a drive moves along the rows of a map; see `ssrvlad_torch.recognition.motion`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

SPEEDS: tuple[tuple[float, dict[int, float]], ...] = (
    (0.08, {-1: 0.05, 0: 0.9, 1: 0.05}),
    (0.16, {0: 0.5, 1: 0.5}),
    (0.34, {0: 0.1, 1: 0.8, 2: 0.1}),
    (0.16, {1: 0.5, 2: 0.5}),
    (0.14, {1: 0.1, 2: 0.8, 3: 0.1}),
    (0.07, {2: 0.1, 3: 0.8, 4: 0.1}),
    (0.05, {3: 0.15, 4: 0.7, 5: 0.15}),
)
"""Probability of each speed along the map, and of its steps in rows."""
PRIOR = np.array([probability for probability, _ in SPEEDS], np.float32)[:, None]
GAP = 5
"""The longest step in rows, and the number of empty cells between two sequences."""
CHANGE, JUMP, STAY = 0.01, 0.01, 0.97
"""Probabilities: a changed speed, a jump, and to stay at places that the map lacks."""
WEIGHT, LEVEL, MAX_LOG = 0.25, 0.5, 50.0
"""The likelihood of a row of z-score z is exp(WEIGHT * (z - LEVEL)), and at most exp(MAX_LOG)."""
NEAR = 5
"""Rows on each side of a row that show its place."""


def start(inside: Floats, unmapped: float, ways: int) -> Floats:
    """``(W, 7, cells)``, the belief before the first frame: each row alike.

    Args:
        inside: ``(cells,)``, 1 in the cells of rows, 0 in those between sequences.
        unmapped: probability of a place that the map lacks.
        ways: W, the number of ways in which the map is run.
    """
    each = (1 - unmapped) / max(1.0, float(inside.sum())) / ways
    return np.stack([PRIOR * (inside * np.float32(each))] * ways)


def after(
    mapped: Floats, unmapped: float, inside: Floats, jump_off: float, ways: Sequence[int]
) -> tuple[Floats, float]:
    """The belief one frame later: ``(W, 7, cells)`` by way, speed and cell, and of a place that the
    map lacks, to which a jump leads with the probability ``jump_off``."""
    mixed = mapped * (1 - CHANGE) + CHANGE * PRIOR * mapped.sum(axis=1, keepdims=True)
    pairs = zip(mixed, ways, strict=True)
    later = np.stack([moved(each, inside, way) for each, way in pairs])
    lost = max(0.0, 1 - unmapped - float(later.sum()))
    arriving = lost * (1 - jump_off) + unmapped * (1 - STAY)
    later += start(inside, 1 - arriving, len(ways))
    return later, lost * jump_off + unmapped * STAY


def moved(mapped: Floats, inside: Floats, way: int) -> Floats:
    """``(7, cells)`` by the steps of each speed, forwards (1) or backwards (-1), without jumps."""
    later, end = np.zeros_like(mapped), mapped.shape[1] - GAP
    for speed, (_, steps) in enumerate(SPEEDS):
        for step, probability in steps.items():
            part = mapped[speed, GAP - way * step : end - way * step]
            later[speed, GAP:end] += np.float32(probability * (1 - JUMP)) * part
    later *= inside
    return later
