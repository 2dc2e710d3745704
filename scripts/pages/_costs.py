"""Costs of methods: encoding and matching frame by frame, all methods in turn, one thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, repeat
from typing import Any

from torch import Tensor

from ssrvlad_torch import baselines
from ssrvlad_torch.baselines import Frame, region_vlad
from ssrvlad_torch.cli.bench import threads
from ssrvlad_torch.stages import residuals
from ssrvlad_torch.stages.harmonics import Harmonics

ENCODED = 10
"""Number of references that are encoded: as many as LoST-X ranks again."""

AGGREGATING: dict[str, tuple[tuple[Any, str], ...]] = {
    "ssr-vlad": (
        *((residuals, name) for name in ("log_polar_bins", "shape_contexts")),
        (residuals.Residuals, "descriptor"),
        *((Harmonics, name) for name in ("histograms", "descriptor")),
    ),
    "region-vlad": ((region_vlad, "vlad"),),
}
"""Functions that turn features into the descriptor, by the beginning of a method's name."""


@dataclass(frozen=True)
class Cost:
    """Milliseconds of every repetition.

    Attributes:
        method: its name, with a note if its weights are random.
        extract: from the frame to the features; for most methods to the descriptor.
        aggregate: from the features to the descriptor; ``None`` if they are not separate.
        match: of one query against all references.
        references: their number.
        bytes_a_reference: size of an encoded reference.
    """

    method: str
    extract: list[float]
    aggregate: list[float] | None
    match: list[float]
    references: int
    bytes_a_reference: float

    @property
    def encode(self) -> list[float]:
        """From the frame to the descriptor."""
        if self.aggregate is None:
            return self.extract
        return [sum(parts) for parts in zip(self.extract, self.aggregate, strict=True)]


def measure(
    methods: Mapping[str, Callable[[], baselines.Method]],
    frames: Sequence[Frame],
    references: int,
    rounds: Mapping[str, int],
) -> dict[str, Cost]:
    """Encodes and matches one frame by every method, then the next frame by every method.

    The first round is not counted. `ENCODED` references are encoded; if an encoding is one tensor,
    it is repeated up to ``references``.

    Args:
        methods: functions that make them, by their names in the table.
        frames: at least one.
        references: to match with.
        rounds: number of frames for each; after the last frame, the first is used again.
    """
    with threads(1):
        runs = {name: _Run(make(), frames, references) for name, make in methods.items()}
        last = max(rounds.values())
        for number in range(-1, last):
            for name, run in runs.items():
                if number < rounds[name]:
                    run.work(number)
            print(f"[round {number + 2} of {last + 1}]", flush=True)
    return {name: run.cost for name, run in runs.items()}


class _Run:
    """A method with the times of its rounds."""

    def __init__(self, method: baselines.Method, frames: Sequence[Frame], references: int) -> None:
        self._method, self._frames = method, frames
        again = (frame for turn in repeat(frames) for frame in turn)
        encoded = method.encode_reference(islice(again, ENCODED))
        self._bytes = encoded.nbytes / len(encoded)
        self._references: Any = _repeated(encoded, references)
        self._watched = next(
            (part for name, part in AGGREGATING.items() if method.name.startswith(name)), None
        )
        self._times: list[tuple[float, float, float]] = []

    def work(self, number: int) -> None:
        """Times one frame; frame -1 is not counted."""
        frame = self._frames[number % len(self._frames)]
        with watched(self._watched or ()) as aggregating:
            begin = time.perf_counter()
            query = self._method.encode_query([frame])
            encoded = time.perf_counter()
            self._method.scores(query, self._references)
            matched = time.perf_counter()
        if number >= 0:
            within = sum(aggregating)
            self._times.append((encoded - begin - within, within, matched - encoded))

    @property
    def cost(self) -> Cost:
        extract, aggregate, match = (
            [1e3 * seconds for seconds in column] for column in zip(*self._times, strict=True)
        )
        count = len(self._references)
        aggregated = aggregate if self._watched else None
        return Cost(self._method.name, extract, aggregated, match, count, self._bytes)


def _repeated(encoded: Any, count: int) -> Any:
    if not isinstance(encoded, Tensor):
        return encoded
    times = -(-count // len(encoded))
    return encoded.repeat(times, *[1] * (encoded.ndim - 1))[:count]


@contextmanager
def watched(places: Sequence[tuple[Any, str]]) -> Iterator[list[float]]:
    """The seconds of every call of some functions, by owner and name, as long as it lasts."""
    taken: list[float] = []

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            begin = time.perf_counter()
            result = function(*arguments)
            taken.append(time.perf_counter() - begin)
            return result

        return call

    originals = [getattr(*place) for place in places]
    try:
        for (owner, name), function in zip(places, originals, strict=True):
            setattr(owner, name, timed(function))
        yield taken
    finally:
        for (owner, name), function in zip(places, originals, strict=True):
            setattr(owner, name, function)
