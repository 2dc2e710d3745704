"""Stretches: where a stream breaks.

Frames of a sequence share light, camera and network only as long as it runs. Where nothing came for
long, and the view is another, the stream goes on as one of another name would.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

GAP, TIMES = 600.0, 10.0
"""A gap is longer than these seconds, in which light does not change much, and than so many times
the usual step."""

RECENT, LEAST = 50, 20
"""Frames before a gap that show what is usual: at most and at least."""

LAST, APART = 3, 10
"""The last frames may show the present place; frames that are farther apart show others."""

LIKE = 0.5
"""How alike frames are: 0 as different places, 1 as one frame and the next. After a gap, the same
view is at least so alike; that of a standing camera."""

SPREADS = 3
"""The usual step is at least so many standard deviations of how alike different places are."""

_ROUNDING = 1e-6


def is_gap(stamps: npt.NDArray[np.float64], stamp: float) -> bool:
    """Whether a stream whose `RECENT` frames have these stamps ``(N,)`` pauses before the next; not
    where a stamp is NaN."""
    if len(stamps) < LEAST or not stamp - stamps[-1] > GAP:
        return False
    return bool(stamp - stamps[-1] > TIMES * np.median(np.diff(stamps)))


def is_elsewhere(channels: Iterable[npt.NDArray[Any]]) -> bool:
    """Whether the last of some frames is unlike those just before it, by their descriptors
    ``(N, *shape)`` in each channel: float32, or uint8 for signs."""
    return bool(np.mean([_likeness(each) for each in channels]) < LIKE)


def _likeness(descriptors: npt.NDArray[Any]) -> float:
    """See `LIKE`. Frames too sparse to be like the next are measured by how much places vary."""
    flat = descriptors.reshape(len(descriptors), -1)
    if descriptors.dtype == np.uint8:
        flat = np.unpackbits(flat, axis=1).astype(np.float32) * 2 - 1
    vectors = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), _ROUNDING)
    near = -np.log(np.maximum(1 - vectors @ vectors.T, _ROUNDING))
    before = near[:-1, :-1]
    others = before[np.tril_indices(len(before), -APART)]
    usual = np.median(np.diag(before, -1)) - np.median(others)
    step = near[-1, -1 - LAST : -1].max() - np.median(others)
    return float(step / max(usual, SPREADS * others.std(), _ROUNDING))
