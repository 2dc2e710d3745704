"""Running a method: every query against all references, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard, TypeVar

import torch
from torch import Tensor

from ..recognition.matching import Matches, best_of
from ..recognition.recognise import Recognised, Steps, recognise, recognise_by_scores
from .protocol import Frame, Method, Sweeping, batches

Result = TypeVar("Result")


@dataclass(frozen=True)
class Cost:
    """Milliseconds a frame: the mean over all frames, and the cheapest and dearest block."""

    average: float
    min: float
    max: float


@dataclass(frozen=True)
class Retrieval:
    """Candidates of every query, and what finding them took.

    Attributes:
        queries, references: ids of the frames, in the order of rows and indices.
        scores: ``(Q, top)`` float32, best first; ``-inf`` where there is no candidate.
        indices: ``(Q, top)`` int64 rows of the references; -1 where there is no candidate. Of
            references with equal scores the earlier comes first.
        encode: encoding a query, without reading it from the disk.
        match: scoring a query against all references, without ranking them.
        bytes_a_reference: size of an encoded reference.
        stepped: what the steps of `recognition` make of it, if they are asked for.
    """

    queries: tuple[str, ...]
    references: tuple[str, ...]
    scores: Tensor
    indices: Tensor
    encode: Cost
    match: Cost
    bytes_a_reference: float
    stepped: Recognised | None = None


def run(
    method: Method,
    queries: Iterable[Frame],
    references: Iterable[Frame],
    top: int = 10,
    block: int = 1,
    progress: Callable[[int], None] | None = None,
    steps: Steps | None = None,
) -> Retrieval:
    """Encodes the references, then takes the queries block by block.

    Frames are taken one after another and are not kept. The first block of queries is worked on
    twice and timed the second time, so that what happens once in a process does not count.

    Args:
        method: from `make`.
        queries: in any order.
        references: the frames of a sequence one after another in order.
        top: candidates of each query.
        block: queries at a time. With 1, the costs are those of single frames.
        progress: called with 1 for every frame that is done.
        steps: what is done besides, between encodings and a decision. Encodings that are vectors
            are standardised and followed, for other methods the scores are followed; the sweep
            needs a `Sweeping` method. The costs are those of single frames.

    Raises:
        ValueError: no references or no queries, ``top`` or ``block`` is below 1, or a frame that
            the method refuses.
    """
    if top < 1 or block < 1:
        raise ValueError(f"expected a top and a block of 1 or more, got {top} and {block}")
    reference_ids, query_ids = list[str](), list[str]()
    encoded = method.encode_reference(_noted(references, reference_ids, progress))
    if not reference_ids:
        raise ValueError(f"method {method.name} got no references")
    found: list[Matches] = []
    kept: list[Tensor] = []
    vectors: Tensor | None = encoded if _are_vectors(encoded) else None
    encoding, matching = _Clock(), _Clock()
    for frames in batches(_noted(queries, query_ids, progress), block):
        if not found:
            method.scores(method.encode_query(frames), encoded)
        wanted = encoding.time(len(frames), method.encode_query, frames)
        scores = matching.time(len(frames), method.scores, wanted, encoded)
        found += [best_of(row, top) for row in scores]
        if steps is not None:
            kept.append(scores if vectors is None else _kept(method, frames, wanted, steps))
    if not found:
        raise ValueError(f"method {method.name} got no queries")
    return Retrieval(
        queries=tuple(query_ids),
        references=tuple(reference_ids),
        scores=torch.stack([one.scores for one in found]),
        indices=torch.stack([one.indices for one in found]),
        encode=encoding.cost,
        match=matching.cost,
        bytes_a_reference=encoded.nbytes / len(reference_ids),
        stepped=_stepped(kept, vectors, query_ids, reference_ids, steps, top) if steps else None,
    )


def _kept(method: Method, frames: Sequence[Frame], wanted: Any, steps: Steps) -> Tensor:
    """The descriptors of queries that the steps need."""
    if steps.sweep and isinstance(method, Sweeping):
        return method.encode_sweep(frames)
    assert isinstance(wanted, Tensor)
    return wanted


def _stepped(
    kept: Sequence[Tensor],
    encoded: Tensor | None,
    queries: Sequence[str],
    references: Sequence[str],
    steps: Steps,
    top: int,
) -> Recognised:
    """By the encodings of queries and references, or, without the latter, by scores."""
    here, there = ([frame.rpartition("/")[0] for frame in ids] for ids in (queries, references))
    if encoded is None:
        return recognise_by_scores(torch.cat(list(kept)), here, there, steps, top)
    return recognise(torch.cat(list(kept)), encoded, here, there, steps, top)


def _are_vectors(encodings: Any) -> TypeGuard[Tensor]:
    return isinstance(encodings, Tensor) and encodings.ndim == 2 and encodings.is_floating_point()


class _Clock:
    """Adds up the seconds of blocks of frames."""

    def __init__(self) -> None:
        self._blocks: list[tuple[int, float]] = []

    def time(self, frames: int, work: Callable[..., Result], *arguments: Any) -> Result:
        begin = time.perf_counter()
        result = work(*arguments)
        self._blocks.append((frames, time.perf_counter() - begin))
        return result

    @property
    def cost(self) -> Cost:
        each = [1e3 * seconds / frames for frames, seconds in self._blocks]
        frames, seconds = (sum(column) for column in zip(*self._blocks, strict=True))
        return Cost(1e3 * seconds / frames, min(each), max(each))


def _noted(
    frames: Iterable[Frame], ids: list[str], progress: Callable[[int], None] | None
) -> Iterator[Frame]:
    for frame in frames:
        ids.append(frame.frame)
        yield frame
        if progress:
            progress(1)
