"""Which library finds the answer of exact search among the codes of all channels.

A row is one vector: its codes by all channels, as they count together. A query is five, with its
features moved by up to two columns. faiss and usearch are no dependencies of the package.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch
from _large_maps import QUERIES, TOP, Report, as_queries, described, opened
from _markdown import commit, head_row, row

from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.search import codes
from ssrvlad_torch.search.codes import Coder
from ssrvlad_torch.search.exact import chosen_channels, recognise_in

DEPTHS = 40, 100, 300, 1000, 2000
SAMPLE, PARTITIONS, PROBED = 4096, 256, (26, 77)
TRUST = {"features": 6.0, "hog": 2.0, "ssr-vlad": 1.0}

Array = npt.NDArray[Any]
Search = Callable[[Array, int], tuple[Array, Array]]
"""From probes ``(P, D)`` and a number to their highest products ``(P, n)``, and the rows."""


class Vectors(NamedTuple):
    """Rows ``(R, D)``; of each query probes ``(Q, P, D)``, what is added to their products ``(Q,
    P)``, and the row of exact search."""

    rows: Array
    probes: Array
    offsets: Array
    answers: Array


def vectors(frames: int, folder: Path) -> Vectors:
    """Of the queries whose answer by exact search is a real frame; kept in the folder."""
    file = folder / f"{frames}.vectors.npz"
    if not file.exists():
        references, queries = opened(frames, folder).load(), described(folder, QUERIES)
        answers = exact_answers(frames, folder)
        is_real = [references.frames[answer].startswith("real/") for answer in answers]
        chosen = np.flatnonzero(is_real)
        sampled = np.sort(np.random.default_rng(0).choice(frames, SAMPLE, replace=False))
        rows, probes, offsets = list[Array](), list[Array](), list[Array]()
        for name, trust in TRUST.items():
            values = references.channels[name]
            coder = Coder.learn(values[sampled])
            units = coder.basis.norm(dim=1)
            part = torch.from_numpy(coder.codes(values)) * units
            seen = codes._probes(queries[name][chosen], name == "features")
            directed = seen @ (coder.basis / units[:, None]).T
            deviation = (directed[:, directed.shape[1] // 2] @ part[sampled].T).std(1)
            usual = deviation.median()
            factor = usual / deviation[:, None]
            rows.append((part * (trust / usual)).numpy())
            count = (len(chosen), 5)
            probes.append((directed * factor[..., None]).expand(*count, -1).numpy())
            offsets.append((seen @ coder.mean * factor * (trust / usual)).expand(count).numpy())
        together = np.concatenate(rows, 1), np.concatenate(probes, 2), sum(offsets)
        np.savez(file, *together, answers[chosen])
    return Vectors(*np.load(file).values())


def exact_answers(frames: int, folder: Path) -> Array:
    """The first answers to all queries, each alone, by exact search in memory."""
    file = folder / f"{frames}.answers.npy"
    if not file.exists():
        database, queries = opened(frames, folder), described(folder, QUERIES)
        references, channels = database.load(), chosen_channels(database)
        answers = []
        for number in range(len(queries["hog"])):
            one = as_queries({n: values[number : number + 1] for n, values in queries.items()})
            found = recognise_in(references, one, channels, Steps(follow=None), TOP)
            answers.append(int(found.matches.indices[0, 0]))
        np.save(file, answers)
    return np.load(file)


def of_faiss(name: str, rows: Array, folder: Path) -> Iterator[tuple[str, float, Search]]:
    """Kinds of search by an index of faiss: in words, bytes a frame, and the search."""
    import faiss

    faiss.omp_set_num_threads(1)
    index = faiss.index_factory(rows.shape[1], name, faiss.METRIC_INNER_PRODUCT)
    index.train(rows)
    index.add(rows)
    size = len(faiss.serialize_index(index)) / len(rows)
    if "IVF" not in name:
        yield "", size, index.search
        return
    for probed in PROBED:
        faiss.extract_index_ivf(index).nprobe = probed
        yield f", {probed} lists", size, index.search


def of_usearch(name: str, rows: Array, folder: Path) -> Iterator[tuple[str, float, Search]]:
    from usearch.index import Index

    index = Index(ndim=rows.shape[1], metric="ip", dtype=name)
    index.add(np.arange(len(rows)), rows, threads=1)
    index.save(folder / "usearch")

    def search(probes: Array, number: int) -> tuple[Array, Array]:
        found = index.search(probes, number, threads=1)
        return 1 - found.distances, found.keys.astype(np.int64)

    yield "", (folder / "usearch").stat().st_size / len(rows), search


def of_lance(name: str, rows: Array, folder: Path) -> Iterator[tuple[str, float, Search]]:
    import lance

    path, length = folder / "vectors.lance", rows.shape[1]
    shutil.rmtree(path, ignore_errors=True)
    column = pa.FixedSizeListArray.from_arrays(pa.array(rows.astype(np.float32).ravel()), length)
    table = lance.write_dataset(pa.table({"vector": column}), str(path))
    settings = {"num_sub_vectors": length // 4} if name == "IVF_PQ" else {}
    table.create_index("vector", name, metric="dot", num_partitions=PARTITIONS, **settings)
    table = lance.dataset(str(path))
    files = (file for file in (path / "_indices").rglob("*") if file.is_file())
    size = sum(file.stat().st_size for file in files) / len(rows)

    def search(probes: Array, number: int, probed: int) -> tuple[Array, Array]:
        products, places = [], []
        for probe in probes:
            nearest = {"column": "vector", "q": probe, "k": number, "metric": "dot"}
            nearest["nprobes"] = probed
            found = table.to_table(columns=["_distance"], nearest=nearest, with_row_id=True)
            products.append(1 - found["_distance"].to_numpy())
            places.append(found["_rowid"].to_numpy().astype(np.int64))
        least = min(map(len, places))
        return np.stack([p[:least] for p in products]), np.stack([p[:least] for p in places])

    for probed in PROBED:
        yield f", {probed} lists", size, partial(search, probed=probed)


def of_product(name: str, rows: Array, folder: Path) -> Iterator[tuple[str, float, Search]]:
    """All rows, whole numbers of 8 bits, by the matrix product of torch, block by block."""
    units = np.abs(rows).max(0) / 127
    whole = torch.from_numpy(np.round(rows / units).astype(np.int8))

    def search(probes: Array, number: int) -> tuple[Array, Array]:
        weights = torch.from_numpy(probes * units)
        products = torch.cat([weights @ part.float().T for part in whole.split(1 << 10)], 1)
        best = products.topk(number)
        return best.values.numpy(), best.indices.numpy()

    yield "", float(rows.shape[1]), search


ENGINES = {
    "one product of all rows, torch": (of_product, ""),
    "Lance, IVF_RQ": (of_lance, "IVF_RQ"),
    "Lance, IVF_PQ": (of_lance, "IVF_PQ"),
    "Lance, IVF_HNSW_SQ": (of_lance, "IVF_HNSW_SQ"),
    "faiss, SQ8": (of_faiss, "SQ8"),
    "faiss, IVF of SQ8": (of_faiss, f"IVF{PARTITIONS},SQ8"),
    "faiss, IVF of PQ96x8": (of_faiss, f"IVF{PARTITIONS},PQ96x8"),
    "faiss, IVF of RaBitQ": (of_faiss, f"IVF{PARTITIONS},RaBitQ"),
    "faiss, PQ192x4fs": (of_faiss, "PQ192x4fs"),
    "usearch, HNSW of f16": (of_usearch, "f16"),
}


def engines(frames: int, folder: Path) -> Report:
    """What each engine finds, and what it costs."""
    os.environ["LANCE_CPU_THREADS"] = "1"
    rows, probes, offsets, answers = vectors(frames, folder)
    report: Report = {"queries": len(answers), "engines": []}
    for name, (kind, settings) in ENGINES.items():
        began, building = time.process_time(), None
        for words, size, search in kind(settings, rows, folder):
            building = time.process_time() - began if building is None else building
            places, started = list[int](), time.process_time()
            for query, answer in enumerate(answers):
                products, found = search(probes[query], DEPTHS[-1])
                best = (products + offsets[query][:, None]).ravel()
                order = found.ravel()[np.argsort(-best, kind="stable")]
                _, first = np.unique(order, return_index=True)
                at = np.flatnonzero(order[np.sort(first)] == answer)
                places.append(int(at[0]) if len(at) else frames)
            spent = (time.process_time() - started) / len(answers)
            found_by = [float(np.mean(np.array(places) < depth)) for depth in DEPTHS]
            report["engines"].append([name + words, size, building, 1e3 * spent, *found_by])
            print(report["engines"][-1], flush=True)
    return report


def in_words(reports: dict[int, Report]) -> Iterator[str]:
    """The section of the page."""
    [(frames, report)] = reports.items()
    yield (
        f"Where the first answer of exact search is among the candidates of an engine, {frames:,} "
        f"frames, all {report['queries']} pictures of {', '.join(QUERIES)} whose answer is a real "
        "frame. A row is one vector of 384 numbers, the codes of all channels by principal "
        "components (256 of features, 64 of HOG and of label maps), as they count together; a "
        "query is five, with its features moved by up to two columns, whose products are "
        f"merged. An index of lists has {PARTITIONS}. Lance keeps the vectors beside its index, at "
        "least 768 bytes a frame. One thread. Measured by `scripts/pages/scale.py "
        f"--engines` of commit {commit()}; the study has ended.\n"
    )
    yield from head_row(
        "engine", "bytes a frame", "build, CPU s", "CPU ms a picture",
        *(f"among {depth}" for depth in DEPTHS),
    )  # fmt: skip
    for name, size, building, spent, *found in report["engines"]:
        costs = f"{size:.0f}", f"{building:.0f}", f"{spent:.0f}"
        yield row(name, *costs, *(f"{share:.3f}" for share in found))
