"""A live stream on arrays: by the native core, or where it is not built by the oracle in NumPy,
slowly.

Both find the same loops; see `native.loops` and `reference`. Needs no torch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .. import native
from ..native import loops as by_core
from ..native.loops import Array, Channel
from . import reference
from .config import LoopConfig

Live = by_core.Loops | reference.Loops

_LENGTH_TOLERANCE = 1e-3


def live(channels: Sequence[Channel], config: LoopConfig) -> Live:
    """A stream without frames; a UserWarning says once where the core is not there."""
    if native.if_built("finds loops") is None:
        return reference.Loops(channels, config.exclude, config.threshold)
    return by_core.Loops(channels, config.exclude, config.threshold)


def checked(channel: Channel, descriptor: Array, frame: str) -> Array:
    """``(S, *shape)`` descriptors of a frame, from ``shape``, or of vectors from S anchors with the
    usual one in the middle; others are a ValueError that names the frame."""
    shape = channel.shape
    if channel.dtype == "uint8":
        if descriptor.shape != shape or descriptor.dtype != np.uint8:
            got = f"{descriptor.shape} {descriptor.dtype}"
            raise ValueError(f"frame {frame!r}: expected signs {shape} uint8, got {got}")
        return descriptor[None]
    vectors = np.atleast_2d(descriptor.astype(np.float32))
    if vectors.ndim != 2 or vectors.shape[1:] != shape or not len(vectors) % 2:
        raise ValueError(
            f"frame {frame!r}: expected a descriptor {shape}, or of an odd number of anchors, got "
            f"{descriptor.shape}"
        )
    require_lengths(vectors, [frame] * len(vectors))
    return vectors


def require_lengths(vectors: npt.NDArray[np.float32], frames: Sequence[str]) -> None:
    """Vectors ``(N, D)`` of length 1 or zero; others are a ValueError that names their frame."""
    lengths = np.linalg.norm(vectors, axis=1)
    wrong = ~((np.abs(lengths - 1) <= _LENGTH_TOLERANCE) | (lengths == 0))
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(
            f"frame {frames[row]!r}: expected a descriptor of length 1 or zero, got "
            f"{lengths[row]:g}"
        )
