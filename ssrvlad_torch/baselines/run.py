"""Runs a method: every query against all references, with the costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..recognition.matching import Matches, best_of
from ..recognition.recognise import Recognised, Steps, recognise, recognise_by_scores
from ..recognition.signs import are_signs
from .protocol import Frame, Method, Sweeping, batches

Result = TypeVar("Result")


@dataclass(frozen=True)
class Cost:
    """Milliseconds per frame: the mean over all frames, and the fastest and slowest block."""

    average: float
    min: float
    max: float


@dataclass(frozen=True)
class Retrieval:
    """Candidates of every query, and the costs.

    Attributes:
        queries, references: ids of the frames, in the order of rows and indices.
        scores: ``(Q, top)`` float32, best first; ``-inf`` for no candidate.
        indices: ``(Q, top)`` int64 rows of the references; -1 for no candidate. If references have
            equal scores, the earlier comes first.
        encode: of encoding a query, without reading it from disk.
        match: of scoring a query against all references, without ranking them.
        bytes_a_reference: size of an encoded reference.
        similarity: ``(Q, R)`` float32, the scores of all pairs, if they were asked for.
        stepped: the result of the steps of `recognition`, if there are steps.
    """

    queries: tuple[str, ...]
    references: tuple[str, ...]
    scores: Tensor
    indices: Tensor
    encode: Cost
    match: Cost
    bytes_a_reference: float
    similarity: Tensor | None = None
    stepped: Recognised | None = None


def run(
    method: Method,
    queries: Iterable[Frame],
    references: Iterable[Frame],
    top: int = 10,
    block: int = 1,
    progress: Callable[[int], None] | None = None,
    steps: Steps | None = None,
    all_pairs: bool = False,
) -> Retrieval:
    """Encodes the references, then takes the queries block by block.

    Frames are taken one after another and not stored. The first block of queries is processed
    twice and timed the second time, so that work that a process does only once is not timed.

    Args:
        method: from `make`.
        queries: in any order.
        references: the frames of a sequence follow each other in order.
        top: number of candidates of each query.
        block: queries at a time. With 1, the costs are those of single frames.
        progress: called with 1 for every frame that is done.
        steps: of `recognition`, in addition. They standardise and follow encodings that are
            vectors; for other methods they follow the scores. The sweep needs a `Sweeping` method.
            The costs do not include them.
        all_pairs: whether to keep the scores of all pairs.

    Raises:
        ValueError: there are no references or no queries, ``top`` or ``block`` is below 1, or the
            method refuses a frame.
    """
    if top < 1 or block < 1:
        raise ValueError(f"expected a top and a block of 1 or more, got {top} and {block}")
    reference_ids, query_ids = list[str](), list[str]()
    encoded = method.encode_reference(_noted(references, reference_ids, progress))
    if not reference_ids:
        raise ValueError(f"method {method.name} got no references")
    matches: list[Matches] = []
    inputs: list[Any] = []
    kept: list[Tensor] = []
    vectors: Tensor | None = None
    if isinstance(encoded, Tensor) and (
        are_signs(encoded) or (encoded.ndim == 2 and encoded.is_floating_point())
    ):
        vectors = encoded
    sweep = method.encode_sweep if steps and steps.sweep and isinstance(method, Sweeping) else None
    encoding, matching = _Clock(), _Clock()
    for frames in batches(_noted(queries, query_ids, progress), block):
        if not matches:
            method.scores(method.encode_query(frames), encoded)
        encodings = encoding.time(len(frames), method.encode_query, frames)
        scores = matching.time(len(frames), method.scores, encodings, encoded)
        matches += [best_of(row, top) for row in scores]
        kept += [scores.float()] if all_pairs else []
        if steps is not None:
            described = sweep(frames) if sweep else encodings
            inputs.append(scores if vectors is None else described)
    if not matches:
        raise ValueError(f"method {method.name} got no queries")
    stepped: Recognised | None = None
    if steps is not None:
        drives, map_drives = (
            [frame.rpartition("/")[0] for frame in ids] for ids in (query_ids, reference_ids)
        )
        found = torch.cat(inputs)
        if vectors is None:
            stepped = recognise_by_scores(found, drives, map_drives, steps, top)
        else:
            stepped = recognise(found, vectors, drives, map_drives, steps, top)
    return Retrieval(
        queries=tuple(query_ids),
        references=tuple(reference_ids),
        scores=torch.stack([match.scores for match in matches]),
        indices=torch.stack([match.indices for match in matches]),
        encode=encoding.cost,
        match=matching.cost,
        bytes_a_reference=encoded.nbytes / len(reference_ids),
        similarity=torch.cat(kept) if all_pairs else None,
        stepped=stepped,
    )


class _Clock:
    """Measures the seconds of blocks of frames."""

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
