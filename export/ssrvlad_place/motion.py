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
JUMP, STAY = 0.01, 0.97
"""Probabilities: a jump, and to stay at places that the map lacks."""
LEVEL, MAX_LOG = 0.5, 50.0
"""The likelihood of a row of z-score z is exp(weight * (z - LEVEL)), and at most exp(MAX_LOG)."""
WAYS = (1, -1)
"""The rows are run forwards and, as a decoy, backwards: what that holds is chance."""


def start(inside: Floats, unmapped: float, ways: Sequence[int] = WAYS) -> Floats:
    """``(W, 7, cells)``, the belief before the first frame: each row alike.

    Args:
        inside: ``(cells,)``, 1 in the cells of rows, 0 in those between sequences.
        unmapped: probability of a place that the map lacks.
    """
    each = (1 - unmapped) / max(1.0, float(inside.sum())) / len(ways)
    return np.stack([PRIOR * (inside * np.float32(each))] * len(ways))


def after(
    mapped: Floats,
    unmapped: float,
    inside: Floats,
    jump_off: float,
    change: float,
    ways: Sequence[int] = WAYS,
) -> tuple[Floats, float]:
    """The belief one frame later: ``(W, 7, cells)`` by way, speed and cell, and of a place that the
    map lacks, to which a jump leads with the probability ``jump_off``; ``change`` is that of a
    changed speed."""
    mixed = mapped * (1 - change) + change * PRIOR * mapped.sum(axis=1, keepdims=True)
    later = moved(mixed, inside, ways)
    lost = max(0.0, 1 - unmapped - float(later.sum()))
    arriving = lost * (1 - jump_off) + unmapped * (1 - STAY)
    later += start(inside, 1 - arriving, ways)
    return later, lost * jump_off + unmapped * STAY


def moved(mapped: Floats, inside: Floats, ways: Sequence[int]) -> Floats:
    """``(W, 7, cells)`` by the steps of each speed, forwards (1) or backwards (-1), without
    jumps."""
    later, end = np.zeros_like(mapped), mapped.shape[2] - GAP
    for number, way in enumerate(ways):
        for speed, (_, steps) in enumerate(SPEEDS):
            for step, probability in steps.items():
                part = mapped[number, speed, GAP - way * step : end - way * step]
                later[number, speed, GAP:end] += np.float32(probability * (1 - JUMP)) * part
    later *= inside
    return later
