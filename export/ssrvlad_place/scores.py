"""Scores of frames by features, and of several methods as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

WEIGHTS = (1 / 7, 6 / 7)
"""Of label maps and of features, as `ssrvlad query` weighs them for single frames."""
REACH = 2
"""Columns of cells by which features are moved to each side."""
ELSEWHERE = 5
"""Rows beyond which a candidate is another place than the first."""

_BLOCK = 1 << 10
_ONES = (
    np.unpackbits(np.arange(1 << 16, dtype=np.uint16).view(np.uint8))
    .reshape(-1, 16)
    .sum(1, np.uint8)
)
_ROUNDING = 1e-6


def nearness(scores: Array) -> Array:
    """Minus the logarithm of 1 - cosine; -inf for a score of -inf."""
    return -np.log(np.maximum(1 - scores, np.float32(_ROUNDING)))


def fused(scores: Sequence[Array], weights: Sequence[float], first: int | None = None) -> Array:
    """``(R,)`` scores of one query by several methods as one, by the rule of `ssrvlad query`: the
    weighted means of their z-scores of nearness, by the mean and deviation of the first rows, or of
    all. -inf where no method has a score."""
    parts = []
    for each, weight in zip(scores, weights, strict=True):
        known = np.isfinite(each)
        near = np.where(known, nearness(each), 0)
        count = max(1, np.count_nonzero(known[:first]))
        mean = near[:first].sum() / count
        centred = np.where(known, near - mean, 0)
        spread = np.sqrt(np.square(centred[:first]).sum() / count)
        parts.append((weight * centred / max(spread, _ROUNDING), weight * mean, weight * spread))
    z, mean, spread = (sum(part) for part in zip(*parts, strict=True))
    none = ~np.isfinite(scores).any(0)
    return np.where(none, -np.inf, -np.expm1(-(mean + spread * z)))


def weights_of(leads: Sequence[float]) -> Sequence[float]:
    """The weights of methods by the leads of their first candidates, as `ssrvlad query` weighs them
    for a drive."""
    known = [weight * max(0.0, lead) for weight, lead in zip(WEIGHTS, leads, strict=True)]
    return [weight / sum(known) for weight in known] if sum(known) > 0 else WEIGHTS


def lead(scores: Array) -> float:
    """How much nearer the first candidate is than the best other place, in standard deviations; 0
    for too few scores ``(R,)``."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    known = np.isfinite(scores)
    near = np.where(known, nearness(scores), 0)
    near = np.where(known, near - near.sum() / max(1, known.sum()), 0)
    first = near.argmax()
    elsewhere = np.abs(np.arange(len(near)) - first) > ELSEWHERE
    spread = np.sqrt(np.square(near).sum() / max(1, known.sum()))
    return float((near[first] - near[elsewhere].max()) / max(spread, _ROUNDING))


def cosines_of_signs(query: Array, rows: Array) -> Array:
    """``(R,)`` float32 by signs ``(16, 16, 16)`` and ``(R, 16, 16, 16)``, of the columns of cells
    that overlap, for the best of all moves."""
    cosines = np.full(len(rows), -1, np.float32)
    columns = len(query)
    for first in range(0, len(rows), _BLOCK):
        block = np.asarray(rows[first : first + _BLOCK])
        best = cosines[first : first + len(block)]
        for move in range(-REACH, REACH + 1):
            ours = query[max(0, -move) : columns - max(0, move)]
            theirs = block[:, max(0, move) : columns - max(0, -move)]
            different = differing(ours, theirs).sum(1) / np.float32(4 * ours.size)
            np.maximum(best, np.float32(1) - different.astype(np.float32), out=best)
    return cosines


def differing(signs: Array, rows: Array) -> Array:
    """``(R, columns)``, how many signs of each column differ; cells have a multiple of 8 bytes."""
    changed = np.ascontiguousarray(rows ^ signs)
    if hasattr(np, "bitwise_count"):  # from NumPy 2.0 on, and five times faster
        counts = np.bitwise_count(changed.view(np.uint64))
    else:
        counts = _ONES[changed.view(np.uint16)]
    return counts.sum((2, 3))
