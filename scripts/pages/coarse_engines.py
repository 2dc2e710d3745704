#!/usr/bin/env python3
"""Writes a section of docs/scale.md: candidates by signs with other engines.

    .venv/bin/python scripts/pages/coarse_engines.py --folder /data --frames 100000

The folder is that of `scale.py --pictures`. Needs `faiss-cpu` and `usearch`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import _large_maps
import faiss
import lance
import numpy as np
import pyarrow as pa
import torch
from _markdown import Page, head_row, row
from usearch.index import Index

from ssrvlad_torch.channels.signs import REACH, moved
from ssrvlad_torch.recognition.comparison import ReferenceRows

BYTES = {256: slice(0, 1), 512: slice(0, None, 8)}
"""Bytes of each cell, by the bytes of a frame."""

BEST, MOVES = 0.01, range(-REACH, REACH + 1)
LISTS, VISITED = 256, 26

Searcher = Callable[[np.ndarray, int], np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("docs/scale.md"))
    given = parser.parse_args()
    faiss.omp_set_num_threads(1)
    torch.set_num_threads(1)
    page = Page("scale.md", given.out, False)
    page.table("## Other engines", table(given.frames, given.folder))


def table(frames: int, folder: Path) -> Iterator[str]:
    reports = json.loads((folder / f"{frames}.json").read_text())
    first = np.array(reports["together"]["first"])
    real = first >= frames - reports["pictures"]["real"]
    queries = _large_maps.described(folder, _large_maps.QUERIES, _large_maps.EVERY)["features"]
    rows = _large_maps.opened(frames, folder).load().channels["features"]
    yield from head_row(
        "engine", "bytes a frame", "build, CPU s", "CPU ms a picture",
        "first answer among the best", "where that is a real frame",
    )  # fmt: skip
    for size, part in BYTES.items():
        known, asked = rows[..., part].contiguous(), queries[..., part].contiguous()
        for name, build in ENGINES.items():
            began = time.process_time()
            search = build(known, folder)
            built, began = time.process_time() - began, time.process_time()
            best = int(BEST * frames)
            found = [search(query, best) for query in asked]
            spent = (time.process_time() - began) / len(asked)
            held = np.array([row in of for row, of in zip(first, found, strict=True)])
            print(size, name, built, spent, held.mean(), held[real].mean(), flush=True)
            yield row(
                name, f"{size}", f"{built:.0f}", f"{1e3 * spent:.0f}", f"{held.mean():.3f}",
                f"{held[real].mean():.3f} of {real.sum()}",
            )  # fmt: skip


def ours(known: torch.Tensor, _folder: Path) -> Callable[[torch.Tensor, int], np.ndarray]:
    rows = ReferenceRows(known, ["map"] * len(known))

    def search(query: torch.Tensor, best: int) -> np.ndarray:
        scores = rows.compare(query[None], False, True)[0]
        return scores.topk(best).indices.numpy()

    return search


def each_move(search: Searcher) -> Callable[[torch.Tensor, int], np.ndarray]:
    """The union of the best of each move."""

    def found(query: torch.Tensor, best: int) -> np.ndarray:
        swept = torch.cat([moved(query[None], step) for step in MOVES])
        return np.unique(search(swept.flatten(1).numpy(), best // len(MOVES)))

    return found


def flat(known: torch.Tensor, _folder: Path) -> Callable[[torch.Tensor, int], np.ndarray]:
    index = faiss.IndexBinaryFlat(8 * known[0].numel())
    index.add(known.flatten(1).numpy())
    return each_move(lambda codes, best: index.search(codes, best)[1])


def lists(known: torch.Tensor, _folder: Path) -> Callable[[torch.Tensor, int], np.ndarray]:
    bits, codes = 8 * known[0].numel(), known.flatten(1).numpy()
    quantizer = faiss.IndexBinaryFlat(bits)
    index = faiss.IndexBinaryIVF(quantizer, bits, LISTS)
    index.own_fields = False
    index.train(codes)
    index.add(codes)
    index.nprobe = VISITED
    index.kept = quantizer
    return each_move(lambda codes, best: index.search(codes, best)[1])


def graph(known: torch.Tensor, _folder: Path) -> Callable[[torch.Tensor, int], np.ndarray]:
    index = Index(ndim=8 * known[0].numel(), metric="hamming", dtype="b1")
    index.add(np.arange(len(known)), known.flatten(1).numpy(), threads=1)
    return each_move(lambda codes, best: index.search(codes, best, threads=1).keys)


def of_lance(known: torch.Tensor, folder: Path) -> Callable[[torch.Tensor, int], np.ndarray]:
    codes = known.flatten(1).numpy()
    values = pa.FixedSizeListArray.from_arrays(pa.array(codes.ravel()), codes.shape[1])
    path = str(folder / f"codes-{codes.shape[1]}.lance")
    shutil.rmtree(path, ignore_errors=True)  # row ids count from 0 in a new data set
    table = lance.write_dataset(pa.table({"codes": values}), path)
    table = table.create_index("codes", "IVF_FLAT", metric="hamming", num_partitions=LISTS)

    def search(codes: np.ndarray, best: int) -> np.ndarray:
        found = [
            table.to_table(
                columns=[], with_row_id=True,
                nearest={
                    "column": "codes", "q": code, "k": best, "nprobes": VISITED,
                    "metric": "hamming",
                },
            )["_rowid"].to_numpy()
            for code in codes
        ]  # fmt: skip
        return np.concatenate(found)

    return each_move(search)


ENGINES = {
    "all rows, by the core": ours,
    "faiss.IndexBinaryFlat": flat,
    "faiss.IndexBinaryIVF, a tenth of the lists": lists,
    "usearch, HNSW": graph,
    "Lance, IVF_FLAT, a tenth of the lists": of_lance,
}


if __name__ == "__main__":
    main()
