"""Matching: cosine scores (Eq. 4) and the best candidates."""

from __future__ import annotations

import math
from operator import index
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Vectors = Tensor | npt.NDArray[np.float32] | npt.NDArray[np.uint8]

_QUERY_BLOCK, _REFERENCE_BLOCK = 1024, 1 << 12
_MOST = 2**31 - 1


class Matches(NamedTuple):
    """Candidates of each query, best first.

    Attributes:
        scores: ``(Q, top)`` float32 cosines; ``-inf`` where there is no candidate.
        indices: ``(Q, top)`` int64 rows of the references; -1 where there is no candidate.
    """

    scores: Tensor
    indices: Tensor

    def _repr_html_(self) -> str:
        return candidates_table(self.scores, self.indices)


@torch.no_grad()
def match(
    queries: Vectors,
    references: Vectors,
    top: int = 5,
    threshold: float | None = None,
    excluded: Tensor | None = None,
) -> Matches:
    """The references with the highest cosine (Eq. 4) to each query.

    The search is exact and goes block by block: the Q x R scores are never in memory at once.
    A zero vector, the descriptor of an empty image, matches nothing. Of references with equal
    scores the earlier comes first.

    Args:
        queries: ``(Q, D)`` float.
        references: ``(R, D)`` float; in memory or memory-mapped, in single or half precision;
            scores are computed in float32.
        top: number of candidates, at least 1.
        threshold: only candidates with a higher score are returned.
        excluded: ``(Q, R)`` bool, references that are no candidates.

    Raises:
        ValueError: the vectors are not two matrices of equal width or hold values that are not
            finite, ``top`` is not from 1 to 2**31 - 1, ``threshold`` is NaN, or ``excluded`` has
            another shape.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch import match
        >>> match(torch.eye(3)[:1], torch.eye(3), top=1).indices
        tensor([[0]])
    """
    queries, vectors = real_tensor(queries, "queries"), real_tensor(references)
    if queries.ndim != 2 or vectors.ndim != 2 or queries.shape[1] != vectors.shape[1]:
        raise ValueError(
            "expected queries (Q, D) and references (R, D) of one width D, "
            f"got {tuple(queries.shape)} and {tuple(vectors.shape)}"
        )
    top = checked_number("top", top, least=1)
    size, mask = (len(queries), len(vectors)), None
    if excluded is not None:
        mask = torch.as_tensor(excluded)
        if mask.shape != size or mask.dtype != torch.bool:
            got = f"{tuple(mask.shape)} {mask.dtype}"
            raise ValueError(f"excluded: expected {size} bool, got {got}")
    if threshold is not None and math.isnan(threshold):
        raise ValueError("threshold: expected a number, got nan")
    scores = queries.new_full((len(queries), top), -torch.inf, dtype=torch.float32)
    indices = torch.full(scores.shape, -1, dtype=torch.int64, device=scores.device)
    units = unit_queries(queries)
    for first in range(0, len(vectors), _REFERENCE_BLOCK):
        block = slice(first, first + _REFERENCE_BLOCK)
        for start in range(0, len(units), _QUERY_BLOCK):
            group = slice(start, start + _QUERY_BLOCK)
            here = cosines(units[group], vectors[block])
            if mask is not None:
                here.masked_fill_(mask[group, block].to(here.device), -torch.inf)
            better = (here.amax(dim=1) > scores[group, -1]).nonzero()[:, 0]
            if len(better):  # most queries find nothing better in a later block
                of = better + start
                highest, columns = _best(here[better], top)
                scores[of], places = _best(torch.cat((scores[of], highest), 1), top)
                indices[of] = torch.cat((indices[of], columns + first), 1).gather(1, places)
    no_candidate = ~(scores > (-torch.inf if threshold is None else threshold))
    return Matches(
        scores.masked_fill(no_candidate, -torch.inf), indices.masked_fill(no_candidate, -1)
    )


def checked_number(name: str, value: int, least: int) -> int:
    """A whole number as `int`; another thing, a bool, a number below the least, and one from 2**31
    on are a ValueError."""
    if not hasattr(value, "__index__") or isinstance(value, bool) or index(value) < least:
        raise ValueError(f"{name} must be an integer from {least}, got {value!r}")
    if index(value) > _MOST:
        raise ValueError(f"{name} must be at most {_MOST}, got {value!r}")
    return index(value)


def cosines(queries: Tensor, vectors: Tensor) -> Tensor:
    """``(Q, R)`` float32 cosines of ``(Q, D)`` `unit_queries` and vectors ``(R, D)``, -inf where a
    vector is zero; values that are not finite are a ValueError."""
    single = vectors.float()
    scores = queries @ single.T
    scores /= _lengths(single)
    return torch.nan_to_num(scores, -torch.inf, torch.inf, -torch.inf, out=scores)


def unit_queries(queries: Vectors) -> Tensor:
    """Queries in float32, of length 1 along the last axis; a zero query becomes NaN, which matches
    nothing. Values that are not finite are a ValueError."""
    single = real_tensor(queries, "queries").float()
    return single / _lengths(single, "queries")[..., None]


def real_tensor(vectors: Vectors, name: str = "references") -> Tensor:
    """Vectors as a tensor; others than of real numbers in memory are a ValueError."""
    try:
        tensor = torch.as_tensor(vectors)
    except (TypeError, ValueError, RuntimeError) as error:
        kind = type(vectors).__name__
        raise ValueError(f"expected {name} as a tensor or an array, got {kind}") from error
    if tensor.is_complex() or tensor.is_meta or tensor.layout is not torch.strided:
        got = f"{tensor.dtype}, {tensor.layout} on {tensor.device}"
        raise ValueError(f"expected {name} of real numbers in memory, got {got}")
    return tensor


def _lengths(vectors: Tensor, name: str = "references") -> Tensor:
    lengths: Tensor = torch.linalg.vector_norm(vectors, dim=-1)
    if len(lengths) and not bool(lengths.amax().isfinite()):
        raise ValueError(f"{name} hold values that are not finite")
    if bool(vectors[lengths == 0].any()):
        raise ValueError(f"{name} hold values too small for float32 to measure their length")
    return lengths


def _best(scores: Tensor, top: int) -> tuple[Tensor, Tensor]:
    """The ``top`` highest scores of each row, or all of fewer, and their columns: falling, and the
    first of equals first.

    ``topk`` takes any of several equal scores. Where more columns than it took are at least as high
    as the last score that it took, a stable sort decides."""
    top = min(top, scores.shape[1])
    best, columns = scores.topk(top, dim=1)
    last = best[:, -1:]
    unclear = ((scores >= last).sum(dim=1, keepdim=True) > top) & last.isfinite()
    columns = columns.sort(dim=1).values
    if bool(unclear.any()):
        rows = unclear[:, 0]
        columns[rows] = scores[rows].sort(dim=1, descending=True, stable=True).indices[:, :top]
    best, order = scores.gather(1, columns).sort(dim=1, descending=True, stable=True)
    return best, columns.gather(1, order)


_MAX_QUERIES, _MAX_CANDIDATES = 10, 5


def candidates_table(scores: Tensor, rows: Tensor, **columns: Tensor) -> str:
    """The row and the score ``(Q, top)`` of the best candidates of the first queries, and further
    numbers ``(Q,)`` of each query by their names."""

    def cell(row: int, score: float) -> str:
        return "none" if math.isinf(score) else f"row {row} ({score:.3f})"

    queries, top = rows.shape
    shown = min(top, _MAX_CANDIDATES)
    names = ["query", *(f"candidate {n}" for n in range(1, shown + 1)), *columns]
    lines = [
        [
            str(query),
            *map(cell, rows[query, :shown].tolist(), scores[query, :shown].tolist()),
            *(f"{column[query]:.3f}" for column in columns.values()),
        ]
        for query in range(min(queries, _MAX_QUERIES))
    ]
    head = "".join(f"<th>{name}</th>" for name in names)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in line)}</tr>" for line in lines)
    left = queries - len(lines)
    more = f"<p>{left} more queries</p>" if left else ""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"
