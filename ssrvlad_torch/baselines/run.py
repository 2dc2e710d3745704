"""Runs a method: every query against all references, with the costs."""

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._pytree import tree_leaves

from ..channels.channel import Channel, View
from ..recognition.matching import Matches
from ..recognition.recognise import Recognised, Steps, recognise, recognise_by_scores, references_of
from .protocol import Method, noting


class Retrieval(NamedTuple):
    """Candidates of every query, and the costs.

    Attributes:
        matches: ``(Q, top)``; if references have equal scores, the earlier comes first.
        costs: milliseconds of a query as ``average``, ``min`` and ``max``, ``encode_ms`` without
            reading it from disk, ``match_ms`` of all scores, without ranking them; and
            ``bytes_a_reference``, encoded.
        stepped: the result of the steps of `recognition`, if there are steps.
    """

    matches: Matches
    costs: dict[str, Any]
    stepped: Recognised | None = None


def run(
    method: Method,
    queries: Iterable[View],
    references: Iterable[View],
    top: int = 10,
    progress: Callable[[int], None] = lambda _: None,
    steps: Steps | None = None,
) -> Retrieval:
    """Encodes the references, then the queries one by one; the first query is encoded twice and
    timed the second time. ``progress`` is called with 1 for every frame. No frames, and one that
    the method refuses, are a ValueError.

    Steps, whose costs are not measured, give a second result. The sweep needs signs, or a method
    with ``encode_sweep``."""
    map_sequences, sequences = list[str](), list[str]()
    encoded = method.encode_reference(noting(references, map_sequences, progress))
    sweep = getattr(method, "encode_sweep", None) if steps and steps.sweep else None
    matches, inputs = list[Matches](), list[Tensor]()
    encode_ms, match_ms = list[float](), list[float]()
    for frame in noting(queries, sequences, progress):
        if not matches:
            method.scores(method.encode_query([frame]), encoded)
        begin = time.perf_counter()
        encodings = method.encode_query([frame])
        between = time.perf_counter()
        scores = method.scores(encodings, encoded)
        match_ms.append(1e3 * (time.perf_counter() - between))
        encode_ms.append(1e3 * (between - begin))
        padded = F.pad(scores.float(), (0, max(0, top - scores.shape[1])), value=-torch.inf)
        ranked, rows = (x[:, :top] for x in padded.sort(dim=1, descending=True, stable=True))
        matches.append(Matches(ranked, rows.masked_fill(ranked == -torch.inf, -1)))
        if steps:
            swept = sweep([frame]) if sweep else encodings
            inputs.append(swept if isinstance(method, Channel) else scores)
    if not matches:
        raise ValueError(f"method {method.name}: no frames to encode")
    costs = {
        "encode_ms": _cost(encode_ms),
        "match_ms": _cost(match_ms),
        "bytes_a_reference": encoded_bytes(encoded) / len(map_sequences),
    }
    retrieval = Retrieval(Matches(*map(torch.cat, zip(*matches, strict=True))), costs)
    if not steps:
        return retrieval
    if isinstance(method, Channel):
        town = references_of({method.name: encoded}, map_sequences)
        stepped = recognise({method.name: torch.cat(inputs)}, sequences, town, steps, top)
    else:
        stepped = recognise_by_scores(torch.cat(inputs), sequences, map_sequences, steps, top)
    return retrieval._replace(stepped=stepped)


def encoded_bytes(encodings: Any) -> int:
    """Bytes of the tensors in encodings."""
    leaves = tree_leaves(encodings)
    return sum(leaf.nbytes for leaf in leaves if isinstance(leaf, Tensor))


def _cost(times: list[float]) -> dict[str, float]:
    return {"average": sum(times) / len(times), "min": min(times), "max": max(times)}
