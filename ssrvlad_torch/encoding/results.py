"""What becomes of frames on their way into a database."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

    from ..database.frames import FrameRecord

Progress = Callable[[int], object]
"""Called with the number of frames done since the last call."""


class Encoded(NamedTuple):
    """A frame and its ``(D,)`` float32 descriptors: its own, and by the names of methods beside."""

    record: FrameRecord
    descriptor: Tensor
    beside: dict[str, Tensor]


class Skipped(NamedTuple):
    """A frame that was not encoded, and why."""

    frame: str
    reason: str


def cores() -> int:
    """Cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def tell_nobody(_what: object) -> None:
    """What is called where nobody wants to know."""


@dataclass(frozen=True)
class EncodeOptions:
    """How a database is filled.

    Attributes:
        workers: threads and processes that read and encode, if not given as many as cores; with 0
            or 1 all is done in the caller's thread.
        complete: the files are all that there are of their folders, so that other frames of these
            are known to be gone.
        prune: with ``complete``, remove the frames that are gone.
        progress: told of every frame that is done.
        skipped: told of every frame that is skipped, at once.
    """

    workers: int | None = None
    complete: bool = False
    prune: bool = False
    progress: Progress = tell_nobody
    skipped: Callable[[Skipped], object] = tell_nobody

    def __post_init__(self) -> None:
        if self.prune and not self.complete:
            raise ValueError("prune wants to know all files of a folder: complete")


@dataclass
class Summary:
    """What an encoding run did.

    Attributes:
        encoded: number of frames that were added.
        anew: number of frames that were there and were encoded anew, by the reason.
        already_there: number of frames that were left as they are.
        empty: number of frames, of those encoded, with a descriptor of zeros.
        pruned: number of frames that were removed because their file is gone.
        gone: ids of frames that are there and whose file is gone.
        skipped: frames that could not be encoded.
    """

    encoded: int = 0
    anew: Counter[str] = field(default_factory=Counter)
    already_there: int = 0
    empty: int = 0
    pruned: int = 0
    gone: list[str] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    @property
    def described(self) -> int:
        """Number of frames that are there and of today's settings."""
        return self.encoded + self.anew.total() + self.already_there

    def __str__(self) -> str:
        told = [f"{self.encoded} frames encoded ({self.empty} of them empty)"]
        told += [f"{count} encoded anew: {reason}" for reason, count in self.anew.items()]
        told.append(f"{self.already_there} already there")
        told += [f"{self.pruned} removed"] if self.pruned else []
        return ", ".join([*told, f"{len(self.skipped)} skipped"])
