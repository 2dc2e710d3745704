"""The results of encoding: encoded and skipped frames, options and the summary."""

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
    """A callback that does nothing."""


@dataclass(frozen=True)
class EncodeOptions:
    """How a database is filled.

    Attributes:
        workers: threads and processes that read and encode; without, as many as cores. With 0 or 1
            all is done in the caller's thread.
        complete: the files are all files of their folders, so that other frames of these are gone.
        prune: with ``complete``, remove the frames that are gone.
        progress: called with the number of frames done since the last call.
        skipped: called with every frame that is skipped, at once.
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
    """The result of an encoding run.

    Attributes:
        encoded: number of new frames.
        anew: number of frames that were encoded again, by the reason.
        already_there: number of frames that were left as they are.
        empty: number of encoded frames with a descriptor of zeros.
        pruned: number of frames that were removed because their file is gone.
        gone: ids of frames in the database whose file is gone.
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
        """Number of frames in the database that are up to date."""
        return self.encoded + self.anew.total() + self.already_there

    def __str__(self) -> str:
        told = [f"{self.encoded} frames encoded ({self.empty} of them empty)"]
        told += [f"{count} encoded anew: {reason}" for reason, count in self.anew.items()]
        told.append(f"{self.already_there} already there")
        told += [f"{self.pruned} removed"] if self.pruned else []
        return ", ".join([*told, f"{len(self.skipped)} skipped"])
