"""Streams of descriptors and settings of the loop detector, drawn at random; shared by tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from ssrvlad_torch.loops.config import LoopConfig

PLACES = np.eye(480, dtype=np.float32)
"""Descriptors of places, at right angles to each other."""


def noisy_stream(
    seed: int, length: int, places: int, changes: list[int]
) -> tuple[npt.NDArray[np.float32], list[str]]:
    """A walk among a few places, forwards, backwards or not at all, with empty frames.

    Returns:
        ``(length, 480)`` descriptors, and the sequence of each frame, another from each of the
        rows ``changes`` on.
    """
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.choice([-1, 0, 1, 1, 1], length), rng.integers(1, 6, length))[:length]
    where = np.cumsum(steps) % places
    vectors = PLACES[where, :24] + rng.normal(0, rng.choice([0.03, 0.1]), (length, 24))
    vectors[rng.random(length) < 0.05] = 0
    lengths = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    padded = np.zeros((length, 480), np.float32)
    padded[:, :24] = vectors / lengths
    sequences = [f"drive {sum(n >= c for c in changes)}" for n in range(length)]
    return padded, sequences


configs = st.builds(
    LoopConfig,
    exclude=st.integers(0, 8),
    temporal=st.integers(0, 2),
    threshold=st.floats(0.3, 1.5),
    relative=st.integers(0, 1),
    ratio=st.sampled_from([0.6, 0.9, 1.0]),
    neighbourhood=st.integers(0, 3),
    confirmations=st.integers(1, 3),
    window=st.integers(0, 2),
)
streams = st.builds(
    noisy_stream,
    st.integers(0, 2**31),
    st.integers(1, 60),
    st.integers(2, 20),
    st.lists(st.integers(0, 60), max_size=2),
)
