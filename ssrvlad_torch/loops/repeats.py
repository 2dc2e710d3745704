"""Repeats: how much the street around a frame repeats itself.

A street that repeats runs forwards, so the map run backwards does not tell it from a loop. But the
frames that a stream excludes cannot be loops: what they have in common with the present frame is
how alike different places of this street are.
"""

from collections import deque

import numpy as np
import numpy.typing as npt

from ..channels.live_vectors import Floats, GrowingArray

MARGIN = 1.2
"""A frame counts as seen again where it is so much nearer than different places are."""

APART = 5
"""Excluded frames that are a fifth of them apart, or more, show different places."""

TRACK = 15
"""Frames over which the nearness of two parts of a drive is averaged, at the same distance or one
frame nearer or farther: single frames of a street with noisy labels are alike by chance."""


class Repeats:
    """For each frame of a sequence, the highest nearness of the frames around it to others of the
    same street, by the last ``exclude`` frames, which are no candidates."""

    def __init__(self, exclude: int) -> None:
        self._nearest, self._farthest = max(1, exclude // APART), exclude
        self._last: deque[Floats] = deque(maxlen=TRACK)
        self._highest = GrowingArray(np.float32)

    def after(self, near: Floats) -> Floats:
        """``(N,)`` float32, a copy, for all earlier frames of the sequence; -inf where nothing is
        known. ``near`` ``(N,)`` is their nearness to the next frame, see `motion.nearness`."""
        while len(self._highest.values) <= len(near):
            self._highest.append(-np.inf)
        highest, last = self._highest.values, min(self._farthest, len(near))
        rows = len(near) - np.arange(self._nearest, last + 1)
        # as many as there are, and one that is beside the last
        distances = max(0, min(self._farthest + 1 - self._nearest, len(rows) + 1))
        seen = np.full(distances + 2, -np.inf, np.float32)
        seen[1 : len(rows) + 1] = near[rows]
        self._last.append(np.maximum(np.maximum(seen[:-2], seen[1:-1]), seen[2:]))
        shared = min(len(rows), *map(len, self._last))
        if len(self._last) == TRACK and shared:
            track = np.mean([each[:shared] for each in self._last], axis=0)
            highest[-TRACK:] = np.maximum(highest[-TRACK:], track.max())
            for age in range(TRACK):
                here = rows[:shared][rows[:shared] >= age] - age
                highest[here] = np.maximum(highest[here], track[: len(here)])
        earlier: npt.NDArray[np.float32] = highest[:-1].copy()
        return earlier
