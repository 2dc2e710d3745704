"""Kinds of index on disk that Lance has, compared on one database."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import lance
import torch

from ssrvlad_torch import match
from ssrvlad_torch.database.checksums import matrix
from ssrvlad_torch.recognition.matching import Matches

KINDS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "IVF_RQ, 1 bit": ("IVF_RQ", 4096, {"num_bits": 1}),
    "IVF_RQ, 1 bit, lists of 1024": ("IVF_RQ", 1024, {"num_bits": 1}),
    "IVF_RQ, 3 bits": ("IVF_RQ", 4096, {"num_bits": 3}),
    "IVF_PQ, 60 codes": ("IVF_PQ", 4096, {"num_sub_vectors": 60}),
    "IVF_RQ, 5 bits": ("IVF_RQ", 4096, {"num_bits": 5}),
    "IVF_SQ": ("IVF_SQ", 4096, {}),
    "IVF_HNSW_SQ": ("IVF_HNSW_SQ", 4096, {}),
}
SCANNED, CANDIDATES = 0.1, 100


def compare(path: Path, queries: torch.Tensor, exact: Matches, names: list[str]) -> Any:
    """Builds each kind in turn in the place of the one before, and asks it.

    Args:
        path: of a table of Lance with a column ``descriptor``; its rows are read in their order.
        queries: ``(Q, D)``.
        exact: their 10 best rows.
        names: of `KINDS`.

    Yields:
        For each: its name, CPU seconds to build, bytes a row, recall at 1 and at 10 of candidates
        that are scored again exactly, CPU milliseconds a query. A tenth of the lists are looked
        through.
    """
    for name in names:
        kind, rows_of_a_list, options = KINDS[name]
        table = lance.dataset(str(path))
        rows = table.count_rows()
        lists = max(1, rows // rows_of_a_list)
        spent = time.process_time()
        table.create_index(
            "descriptor", kind, metric="cosine", replace=True, num_partitions=lists, **options
        )
        built = time.process_time() - spent
        table = lance.dataset(str(path))
        [described] = table.describe_indices()
        probes = max(1, round(SCANNED * lists))
        spent = time.process_time()
        found = [_ask(table, query, probes) for query in queries]
        asked = time.process_time() - spent
        recall = {
            str(n): sum(
                len({*ours[:n]} & {*theirs[:n]})
                for ours, theirs in zip(found, exact.indices.tolist(), strict=True)
            )
            / (n * len(found))
            for n in (1, 10)
        }
        yield {
            "kind": name,
            "build": built,
            "bytes": (described.total_size_bytes or 0) / rows,
            "recall": recall,
            "query": asked / len(found) * 1e3,
        }


def _ask(table: lance.LanceDataset, query: torch.Tensor, probes: int) -> list[int]:
    """The 10 best rows by the index; `scale.records` counts them in x."""
    nearest = {"column": "descriptor", "q": query.numpy(), "k": CANDIDATES, "nprobes": probes}
    found = table.to_table(
        columns=["descriptor", "x"], nearest=nearest, disable_scoring_autoprojection=True
    )
    best = match(query[None], matrix(found["descriptor"]).copy(), 10)
    places = found["x"].to_numpy()
    return [int(places[row]) for row in best.indices[0].tolist() if row >= 0]
