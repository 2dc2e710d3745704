"""A geometric check for loop closures: do the keypoints of two frames agree up to a shift?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..config import CATEGORY_COUNT
from .sighting import KeyPoints, Sighting


@dataclass(frozen=True)
class SharedKeypoints:
    """Whether enough keypoints of two frames stand in the same places; a `GeometricCheck`.

    Frames without keypoints, from a database or given as descriptors, are let through.

    Attributes:
        share: least share of the keypoints of the frame that has fewer, see `shared_keypoints`.
        shift: largest shift between the two frames in pixels of the working grid, each way.
    """

    share: float = 0.16
    shift: int = 6

    def __call__(self, here: Sighting, there: Sighting) -> bool:
        """Whether two frames can show the same place."""
        if here.keypoints is None or there.keypoints is None:
            return True
        return shared_keypoints(here.keypoints, there.keypoints, self.shift) >= self.share


def shared_keypoints(here: KeyPoints, there: KeyPoints, shift: int) -> float:
    """Pairs of keypoints of one category that agree on a shift, by the size of the smaller set.

    Every such pair votes for its shift, as in a Hough transform; votes that differ by a pixel each
    way are counted together.

    Args:
        here, there: ``(P, 3)`` and ``(Q, 3)``, category, row and column.
        shift: largest shift of rows and of columns, in pixels.

    Returns:
        0 or more; 0 if a frame has no keypoints. It may pass 1 where keypoints crowd.
    """
    side = 2 * shift + 1
    votes = np.zeros((side + 2, side + 2), np.int64)
    for category in range(CATEGORY_COUNT):
        ours, theirs = (
            points[points[:, 0] == category, 1:].astype(np.int64) for points in (here, there)
        )
        shifts = (ours[:, None] - theirs[None]).reshape(-1, 2)
        small = shifts[(np.abs(shifts) <= shift).all(axis=1)] + shift + 1
        np.add.at(votes, (small[:, 0], small[:, 1]), 1)
    together = sliding_window_view(votes, (3, 3)).sum(axis=(2, 3))
    return float(together.max() / max(1, min(len(here), len(there))))
