"""Rows of a large map, read from disk when they are needed, with what their sequences lose."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels.channel import Channel
from ..recognition.comparison import ReferenceRows
from ..recognition.sequences import runs
from ..recognition.standardise import sharing
from .alone import LargeMap
from .coarse_index import taken

SAMPLE = 1000
"""Rows that represent all rows."""

_CACHED, _MEANS = 1 << 14, 1 << 10


class MapRows:
    """The descriptors of rows of a map, read from disk when they are needed, and the means of their
    sequences. A damaged row that is read is a ValueError."""

    def __init__(self, large: LargeMap) -> None:
        self._large, rows = large, len(large.frames)
        parts = [*runs(large.frames.sequences)]
        names = [large.frames.sequences[part.start] for part in parts]
        frames = [len(part) for part in parts]
        group_of = np.zeros(len(parts), np.int64)
        self._members: list[list[str]] = []
        for group, those in sharing(frames).items():
            group_of[list(group)] = len(self._members)
            self._members.append([names[number] for number in those])
        self._groups, self._sequences = np.repeat(group_of, frames), len(parts)
        self._means: dict[tuple[str, int], Tensor] = {}
        self._slots, self._used = torch.full((rows,), -1), 0
        self._held: dict[str, Tensor] = {}

    def sample(self, allowed: npt.NDArray[np.bool_]) -> Tensor:
        """``(M,)`` int64, rows that represent all allowed ones ``(R,)`` bool."""
        rows = np.flatnonzero(allowed)
        chosen = np.random.default_rng(0).choice(rows, min(SAMPLE, len(rows)), replace=False)
        return torch.from_numpy(np.sort(chosen))

    def references(self, channel: Channel, rows: Tensor, standardised: bool) -> ReferenceRows:
        """Rising rows by one channel. Those that share a mean are as of one sequence."""
        groups, means = self._groups[rows.numpy()], None
        if standardised:
            each = [self._mean(channel, number) for number in np.unique(groups).tolist()]
            means = torch.stack(each) if each else None
        known = self._read(rows, channel.column.name)
        return channel.references(known, [str(number) for number in groups], means)

    def _mean(self, channel: Channel, group: int) -> Tensor:
        """What is subtracted from the frames of a group of sequences."""
        members = self._members[group] if self._members else []
        key = channel.column.name, group if len(members) < self._sequences else -1
        if key not in self._means:
            if len(self._means) >= _MEANS:
                self._means.clear()
            self._means[key] = self._large.index.mean(channel.column.name, members)
        return self._means[key]

    def _read(self, rows: Tensor, name: str) -> Tensor:
        missing = rows[self._slots[rows] < 0]
        if self._used + len(missing) > _CACHED:
            self._slots.fill_(-1)
            self._used, missing = 0, rows
        if len(missing) > _CACHED:
            return self._taken(missing)[name]
        if len(missing):
            last = self._used + len(missing)
            for each, values in self._taken(missing).items():
                if each not in self._held:
                    self._held[each] = values.new_empty(_CACHED, *values.shape[1:])
                self._held[each][self._used : last] = values
            self._slots[missing] = torch.arange(self._used, last)
            self._used = last
        return self._held[name][self._slots[rows]]

    def _taken(self, rows: Tensor) -> dict[str, Tensor]:
        columns = [channel.column for channel in self._large.channels]
        return taken(self._large.database, self._large.stored[rows.numpy()], columns, True)
