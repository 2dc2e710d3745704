"""The results of encoding: encoded and skipped frames, options and the summary."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy.typing as npt

from ..database.frames import FrameRecord
from ..datasets.frame_file import Skipped as Skipped  # noqa: PLC0414 - others take it from here

Note = Callable[[str], object]
"""Called with what the user should know."""

Progress = Callable[[int], object]
"""Called with the number of frames done since the last call."""


class Encoded(NamedTuple):
    """A frame, and its descriptors by the names of the channels."""

    record: FrameRecord
    descriptors: dict[str, npt.NDArray[Any]]

    @property
    def is_empty(self) -> bool:
        """Whether the descriptor of the first channel is zero."""
        return not next(iter(self.descriptors.values())).any()


def do_nothing(_value: object) -> None:
    """The default callback."""


@dataclass(frozen=True)
class EncodeOptions:
    """Options of encoding into a database.

    Attributes:
        workers: number of threads that read and encode, by default the number of cores. With 0 or 1
            everything runs in the caller's thread.
        complete, prune: the files are all files of their folders: frames without a file are gone;
            with ``prune`` they are removed.
        progress: called with the number of frames done since the last call.
        skipped: called with every frame that is skipped, immediately.
        gpus: number of GPUs for each worker of Ray that runs a network.
    """

    workers: int | None = None
    complete: bool = False
    prune: bool = False
    progress: Progress = do_nothing
    skipped: Callable[[Skipped], object] = do_nothing
    gpus: float = 0

    def __post_init__(self) -> None:
        if self.prune and not self.complete:
            raise ValueError("prune needs all files of a folder: expected complete=True")


@dataclass
class Summary:
    """The result of an encoding run: the numbers of new frames, of those encoded again by reason,
    of those that were up to date, of encoded ones whose descriptor is zero, and of those that were
    removed; ids of frames whose file is gone; and frames that could not be encoded."""

    encoded: int = 0
    anew: Counter[str] = field(default_factory=Counter)
    already_there: int = 0
    empty: int = 0
    pruned: int = 0
    gone: list[str] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

    def __str__(self) -> str:
        parts = [f"{self.encoded} frames encoded ({self.empty} of them empty)"]
        parts += [f"{count} encoded anew: {reason}" for reason, count in self.anew.items()]
        parts.append(f"{self.already_there} already there")
        parts += [f"{self.pruned} removed"] if self.pruned else []
        return ", ".join([*parts, f"{len(self.skipped)} skipped"])
