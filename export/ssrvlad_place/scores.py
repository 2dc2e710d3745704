"""Scores of frames by channels, and of several channels as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

LABEL_SHAPES, FEATURES, HOG = "ssr-vlad", "features", "hog"
TRUST = {LABEL_SHAPES: 1.0, FEATURES: 6.0, HOG: 2.0}
"""How much each channel counts before anything is known of a drive, as in `ssrvlad query`."""
REACH = 2
"""Columns of cells by which features are moved to each side."""
ELSEWHERE = 5
"""Rows beyond which a candidate is another place than the first."""

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
    """``(R,)`` scores of one query by several channels as one, by the rule of `ssrvlad query`: the
    weighted means of their z-scores of nearness, by the mean and deviation of the first rows, or of
    all. -inf where no channel has a score."""
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


def weights_of(leads: Mapping[str, float]) -> list[float]:
    """The weights of channels by the leads of their first candidates, as `ssrvlad query` weighs
    them for a drive; where none leads, as for single frames."""
    known = {name: TRUST[name] * max(0.0, lead) for name, lead in leads.items()}
    weights = known if sum(known.values()) > 0 else {name: TRUST[name] for name in leads}
    return [weight / sum(weights.values()) for weight in weights.values()]


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


def differing(signs: Array, rows: Array) -> Array:
    """``(R, columns)``, how many signs of each column differ; cells have a multiple of 8 bytes."""
    changed = np.ascontiguousarray(rows ^ signs)
    if hasattr(np, "bitwise_count"):  # from NumPy 2.0 on, and five times faster
        counts = np.bitwise_count(changed.view(np.uint64))
    else:
        counts = _ONES[changed.view(np.uint16)]
    return counts.sum((2, 3))
