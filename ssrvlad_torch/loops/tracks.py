"""Tracks: whether an old part of a stretch runs beside the present one more closely than by chance.

In another light, a frame is nowhere near as like the old frame of its place as the frame before.
But the two drives run on side by side. How far that can happen by chance the stream itself shows:
most frames are at new places.
"""

from collections import deque

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

KEPT = 0.93
"""A track is a mean over frames, in which each counts so much of the next."""

BY_CHANCE = 1.5
"""A track so many times as close as the closest by chance is a return."""

CLEAR, SAME = 0.12, 0.75
"""Closeness is 0 for different places and 1 for a frame and the next. Where tracks by chance are
closer than the first, places look too alike to be told apart in another light; a track closer than
the second is in the same light."""

USUAL, EARLIER = 100, 1000
"""Frames that show what is usual, and frames whose closest track is one by chance."""

LEAST, WAIT = 5, 25
"""Frames by chance that must be known; and how long no loop is closed before and after them."""

_AROUND, _BESIDE = 50, 10
_LEAST_STEP = 0.02


class Tracks:
    """How closely the frames of a stretch before each earlier frame run beside the last ones."""

    def __init__(self) -> None:
        self._closeness = np.zeros(0, np.float32)
        self._steps, self._others = deque[float](maxlen=USUAL), deque[float](maxlen=USUAL)
        self._waiting, self._by_chance = deque[float](), deque[float](maxlen=EARLIER)
        self._since, self._closest = WAIT, 0.0

    @property
    def returning(self) -> bool:
        """Whether the last frames run beside old ones in another light."""
        if len(self._by_chance) < LEAST:
            return False
        highest = max(self._by_chance)
        return highest <= CLEAR and BY_CHANCE * highest <= self._closest < SAME

    def after(self, near: Floats, old: int) -> None:
        """Takes the nearness ``(N,)`` of the next frame to all earlier ones, of which the first are
        old; -inf where a frame is empty."""
        before, self._closeness = self._closeness, np.zeros(len(near), np.float32)
        if len(near) < 2 * _BESIDE or near[-1] == -np.inf:
            return
        seen = near[-_AROUND:-_BESIDE]
        self._steps.append(float(near[-1]))
        self._others.append(float(np.median(seen)))
        step = max(_LEAST_STEP, float(np.median(self._steps) - np.median(self._others)))
        known = near[:old][near[:old] > -np.inf]
        if not len(known):
            return
        close = (near - known.mean()) / step
        close[close == -np.inf] = 0
        self._closeness[len(near) - len(before) :] = KEPT * before
        self._closeness += (1 - KEPT) * close
        self._closest = float(self._closeness[:old].max())

    def decided(self, accepted: bool) -> None:
        """Takes whether the frame closes a loop: tracks around one are not by chance."""
        self._since = 0 if accepted else self._since + 1
        if accepted:
            self._waiting.clear()
        elif self._since > WAIT and self._closest:
            self._waiting.append(self._closest)
            if len(self._waiting) > WAIT:
                self._by_chance.append(self._waiting.popleft())
