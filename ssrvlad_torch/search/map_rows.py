"""Rows of a large map, read from disk when they are needed, with what their sequences lose."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..recognition.comparison import References
from .coarse_index import taken
from .sums import mean_of, means_of

if TYPE_CHECKING:
    from ..channels.channel import Channel
    from .alone import LargeMap

SAMPLE = 1000
"""Rows that represent all rows."""

_CACHED = 1 << 14


class MapRows:
    """The descriptors of rows of a map, read from disk when they are needed, and the means of their
    sequences. A damaged row that is read is a ValueError."""

    def __init__(self, large: LargeMap) -> None:
        self._large, rows = large, len(large.frames)
        names = large.frames.sequences
        self._sequences, numbers = list(dict.fromkeys(names)), dict[str, int]()
        for name in self._sequences:
            numbers[name] = len(numbers)
        self._of = np.fromiter((numbers[name] for name in names), np.int64, rows)
        self._sharing = means_of(np.bincount(self._of).tolist())
        self._means: dict[tuple[str, tuple[int, ...]], Tensor] = {}
        self._slots, self._used = torch.full((rows,), -1), 0
        self._held: dict[str, Tensor] = {}

    @cached_property
    def sample(self) -> Tensor:
        """``(M,)`` int64, rows that represent all rows."""
        rows = len(self._of)
        chosen = np.random.default_rng(0).choice(rows, min(SAMPLE, rows), replace=False)
        return torch.from_numpy(np.sort(chosen))

    def references(self, channel: Channel, rows: Tensor, standardised: bool) -> References:
        """Rising rows by one channel."""
        of, name = self._of[rows.numpy()], channel.column.name
        means = None
        if standardised:
            each = [self._mean(channel, number) for number in of[np.diff(of, prepend=-1) != 0]]
            means = torch.stack(each) if each else None
        known = self._read(rows, name)
        return channel.references(known, [self._sequences[number] for number in of], means)

    def _mean(self, channel: Channel, number: int) -> Tensor:
        """What is subtracted from the frames of a sequence."""
        name, those = channel.column.name, self._sharing[number]
        key = name, those if len(those) < len(self._sequences) else ()
        if key not in self._means:
            of = [self._sequences[each] for each in those]
            self._means[key] = (
                self._large.index.mean(name, of) if of else mean_of((), channel.column)
            )
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
