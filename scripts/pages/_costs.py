"""Costs of a method: encoding and matching frame by frame."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle, islice
from typing import Any
from unittest.mock import patch

from torch import Tensor

from ssrvlad_torch import baselines
from ssrvlad_torch.baselines import region_vlad
from ssrvlad_torch.channels.channel import View

ENCODED = 10
"""Number of references that are encoded: as many as LoST-X ranks again."""


class Cost:
    """A method, and the milliseconds of each of its rounds.

    Attributes:
        method: its name, with a note if its weights are random.
        extract: from the frame to the features; for most methods to the descriptor.
        aggregate: from the features to the descriptor, of Region-VLAD; else 0.
        match: of one query against all references.
        references: their number.
        bytes_a_reference: size of an encoded reference.
    """

    def __init__(self, method: baselines.Method, frames: Sequence[View], references: int) -> None:
        encoded = method.encode_reference(islice(cycle(frames), ENCODED))
        self._method, self._frames = method, frames
        self._known: Any = _repeated(encoded, references)
        self.method = method.name
        self.references = len(self._known)
        self.bytes_a_reference = encoded.nbytes / len(encoded)
        self.extract, self.aggregate, self.match = list[float](), list[float](), list[float]()

    @property
    def encode(self) -> list[float]:
        """From the frame to the descriptor."""
        return [sum(parts) for parts in zip(self.extract, self.aggregate, strict=True)]

    def work(self, number: int) -> None:
        """Times one frame; frame -1 is not counted."""
        frame = self._frames[number % len(self._frames)]
        with aggregation() as aggregating:
            begin = time.perf_counter()
            query = self._method.encode_query([frame])
            encoded = time.perf_counter()
            self._method.scores(query, self._known)
            matched = time.perf_counter()
        if number >= 0:
            within = sum(aggregating)
            self.extract.append(1e3 * (encoded - begin - within))
            self.aggregate.append(1e3 * within)
            self.match.append(1e3 * (matched - encoded))


def _repeated(encoded: Any, count: int) -> Any:
    if not isinstance(encoded, Tensor):
        return encoded
    times = -(-count // len(encoded))
    return encoded.repeat(times, *[1] * (encoded.ndim - 1))[:count]


@contextmanager
def aggregation() -> Iterator[list[float]]:
    """The seconds of every call of `region_vlad.vlad`, as long as it lasts."""
    taken, vlad = list[float](), region_vlad.vlad

    def timed(*arguments: Any) -> Any:
        begin = time.perf_counter()
        result = vlad(*arguments)
        taken.append(time.perf_counter() - begin)
        return result

    with patch.object(region_vlad, "vlad", timed):
        yield taken
