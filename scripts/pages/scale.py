#!/usr/bin/env python3
"""Writes docs/scale.md: a million frames through a database, measured here, and what more need.

    .venv/bin/python scripts/pages/scale.py --camvid ../shared/data/camvid

Every step runs in a process of its own, so that its peak of memory is its own, and in one thread,
so that its seconds are those of one core. The descriptors are
those of label maps of the synthetic city, varied: parts of two of them and noise. Needs the extra
``search``, four times the database on the disk (8 GB for a million), and a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ssrvlad_torch.database.searching import Ivfpq, load_mapped
from ssrvlad_torch.database.storage.verification import verify

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, match
from ssrvlad_torch.database.database import Database, FrameRecord
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.encoding.encoder import PART_ROWS, encode_to_memory

LABELS_AS = "cityscapes-trainids"
SEEDS, FRAMES_OF_A_SEED = 4, 64
FRAMES_OF_A_SEQUENCE = 10_000
QUERIES = 1000
NOISE = 0.15
TEMPORAL = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()),
                        help="where a temporary folder is made for the database")  # fmt: skip
    parser.add_argument("--camvid", type=Path, required=True, help="label maps of real drives")
    parser.add_argument("--out", type=Path, default=Path("docs/scale.md"))
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.step:
        print(json.dumps(measured(STEPS[given.step], given)))
        return
    results = {}
    with tempfile.TemporaryDirectory(prefix="scale-", dir=given.folder) as folder:
        for step in STEPS:
            results[step] = run(step, folder, given)
            print(step, results[step], file=sys.stderr, flush=True)
    given.out.write_text(page(given.frames, results), encoding="utf-8")


def run(step: str, folder: str, given: argparse.Namespace) -> dict[str, Any]:
    command = [sys.executable, __file__, "--step", step, "--folder", folder]
    command += ["--frames", str(given.frames), "--camvid", given.camvid]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def measured(step: Callable[[argparse.Namespace], dict[str, Any]], given: Any) -> dict[str, Any]:
    """What a step reports, its time where it keeps none, and the peak of its memory."""
    began, spent = time.perf_counter(), time.process_time()
    report = step(given)
    report.setdefault("seconds", time.perf_counter() - began)
    report.setdefault("cpu_seconds", time.process_time() - spent)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {**report, "peak": peak, "load": os.getloadavg()[0]}


def seeds(given: argparse.Namespace) -> torch.Tensor:
    """``(S, D)`` descriptors of frames of some synthetic cities, made once."""
    file = given.folder / "seeds.npy"
    if file.exists():
        return torch.from_numpy(np.load(file))
    head = SSRVLAD.from_preset("default", labels_as=LABELS_AS)
    found = []
    for seed in range(SEEDS):
        frames = SyntheticCity(seed).traverse(FRAMES_OF_A_SEED, labels_as=LABELS_AS)
        labels = torch.from_numpy(np.stack([frame.labels for frame in frames]))
        found += [head(batch) for batch in labels.split(16)]
    np.save(file, torch.cat(found).numpy())
    return torch.cat(found)


def varied(first: int, count: int, basis: torch.Tensor) -> torch.Tensor:
    """``(count, D)`` descriptors: of two frames, category by category, and noise where they have
    any."""
    generator = torch.Generator().manual_seed(first)
    one, other = (torch.randint(len(basis), (count,), generator=generator) for _ in range(2))
    taken = (
        torch.rand(count, 8, generator=generator).lt(0.5).repeat_interleave(basis.shape[1] // 8, 1)
    )
    numbers = torch.where(taken, basis[one], basis[other])
    scale = NOISE * numbers.abs().mean(dim=1, keepdim=True)
    noise = torch.randn(numbers.shape, generator=generator) * scale
    return torch.nn.functional.normalize(numbers + noise * (numbers != 0), dim=1)


def records(first: int, count: int) -> list[FrameRecord]:
    return [
        FrameRecord(
            f"drive-{n // FRAMES_OF_A_SEQUENCE:06d}", f"{n % FRAMES_OF_A_SEQUENCE:06d}",
            LABELS_AS, 240, 320, f"{n:032x}", float(n), 0.0, 0.0, n + 1,
        )
        for n in range(first, first + count)
    ]  # fmt: skip


def write(given: argparse.Namespace) -> dict[str, Any]:
    """A million frames, part by part, each on the disk before the next."""
    basis = seeds(given)
    config = SSRVLADConfig.from_preset("default", labels_as=LABELS_AS)
    database = Database.create(given.folder / "db", config)
    seconds = spent = 0.0
    with database.writing():
        for first in range(0, given.frames, PART_ROWS):
            count = min(PART_ROWS, given.frames - first)
            numbers, rows = varied(first, count, basis), records(first, count)
            began, cpu = time.perf_counter(), time.process_time()
            database.append(rows, numbers)
            seconds += time.perf_counter() - began
            spent += time.process_time() - cpu
    size = sum(file.stat().st_size for file in database.path.iterdir())
    return {"seconds": seconds, "cpu_seconds": spent, "bytes": size}


def reopen(given: argparse.Namespace) -> dict[str, Any]:
    """What a second run of ``encode`` reads before it starts: every frame that is there."""
    return {"frames": len(Database.open(given.folder / "db").known().rows)}


def check(given: argparse.Namespace) -> dict[str, Any]:
    assert verify(given.folder / "db") == []
    return {}


def load(given: argparse.Namespace) -> dict[str, Any]:
    return {"frames": len(Database.open(given.folder / "db").load(TEMPORAL).frames)}


def queries(given: argparse.Namespace) -> torch.Tensor:
    return varied(0, QUERIES, seeds(given).flip(0))


def exact(given: argparse.Namespace, kind: str) -> dict[str, Any]:
    """Times the search alone; writes what it found for the steps that follow."""
    database, wanted = Database.open(given.folder / "db"), queries(given)
    began = time.perf_counter()
    if kind == "memory":
        references = database.load(TEMPORAL).descriptors
    else:
        references = load_mapped(database, TEMPORAL, kind).descriptors
    opened = time.perf_counter() - began
    began, spent = time.perf_counter(), time.process_time()
    found = match(wanted, references, 10)
    seconds, cpu = time.perf_counter() - began, time.process_time() - spent
    spent = time.process_time()
    for query in wanted[:5]:
        match(query[None], references, 10)
    alone = (time.process_time() - spent) / 5
    np.savez(given.folder / f"{kind}.npz", rows=found.indices[:, 0], scores=found.scores[:, 0])
    return {"seconds": seconds, "cpu_seconds": cpu, "open": opened, "one": alone,
            **beside_memory(given, kind)}  # fmt: skip


def beside_memory(given: argparse.Namespace, kind: str) -> dict[str, float]:
    """How often the best match is that of the exact search, and how far off its score is."""
    wanted, found = (np.load(given.folder / f"{name}.npz") for name in ("memory", kind))
    return {"agreement": float(np.mean(found["rows"] == wanted["rows"])),
            "off": float(np.abs(found["scores"] - wanted["scores"]).max())}  # fmt: skip


def build(given: argparse.Namespace) -> dict[str, Any]:
    database = Database.open(given.folder / "db")
    references = load_mapped(database, TEMPORAL).descriptors
    report = Ivfpq.of(database, references, TEMPORAL).report
    assert report is not None
    return {"bytes": report.bytes, "lists": report.lists, "probes": report.probes,
            "recall_at": report.recall_at}  # fmt: skip


def approximate(given: argparse.Namespace) -> dict[str, Any]:
    database, wanted = Database.open(given.folder / "db"), queries(given)
    index = Ivfpq.of(database, load_mapped(database, TEMPORAL).descriptors, TEMPORAL)
    began, spent = time.perf_counter(), time.process_time()
    found = index.match(wanted, 10)
    seconds, cpu = time.perf_counter() - began, time.process_time() - spent
    np.savez(given.folder / "ivfpq.npz", rows=found.indices[:, 0], scores=found.scores[:, 0])
    return {"seconds": seconds, "cpu_seconds": cpu, **beside_memory(given, "ivfpq")}


def drives(given: argparse.Namespace) -> dict[str, Any]:
    """Recall@1 of odd frames against even ones of real drives, a neighbouring frame is right; and
    what reading and describing a frame takes."""
    head = SSRVLAD.from_preset("default", labels_as="camvid-11")
    hits: dict[str, list[bool]] = {"float32": [], "float16": []}
    count, spent = 0, 0.0
    for drive in sorted(given.camvid.glob("*/labels")):
        files, cpu = find_label_files([str(drive)]), time.process_time()
        frames, _ = encode_to_memory(head, files, workers=0)
        count, spent = count + len(files), spent + time.process_time() - cpu
        for name in hits:
            stored = frames.descriptors[::2].to(getattr(torch, name))
            rows = match(frames.descriptors[1::2], stored, 1).indices[:, 0]
            hits[name] += [int(row) - n in (0, 1) for n, row in enumerate(rows)]
    return {name: float(np.mean(found)) for name, found in hits.items()} | {
        "queries": len(hits["float32"]), "frame": spent / count,
    }  # fmt: skip


STEPS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "nothing": lambda given: {},
    "write": write,
    "reopen": reopen,
    "verify": check,
    "load": load,
    "memory": lambda given: exact(given, "memory"),
    "float32": lambda given: exact(given, "float32"),
    "float16": lambda given: exact(given, "float16"),
    "build": build,
    "ivfpq": approximate,
    "drives": drives,
}

NAMES = {
    "nothing": "nothing: Python, torch and pyarrow as they are loaded",
    "write": "write, every part on the disk before the next",
    "reopen": "open for a second run: ids, digests, stamps",
    "verify": "verify every byte",
    "load": f"load with the temporal sum, t = {TEMPORAL}",
    "memory": f"{QUERIES} queries, exact, in memory",
    "float32": f"{QUERIES} queries, exact, memory-mapped float32",
    "float16": f"{QUERIES} queries, exact, memory-mapped float16",
    "build": "build the index of faiss, with its recall",
    "ivfpq": f"{QUERIES} queries by the index, scored anew",
}


def page(frames: int, results: dict[str, dict[str, Any]]) -> str:
    lines = [
        "# A million frames, and more",
        "",
        f"Written by `scripts/pages/scale.py` on {platform.machine()}, {os.cpu_count()} cores, "
        f"torch {torch.__version__}, {frames:,} frames of the preset `default`, synthetic: "
        "descriptors "
        "of label maps of the synthetic city, varied. Each step is a process of its own with one "
        "thread; its peak counts all that it holds, torch among it, and of a memory-mapped matrix "
        "the pages that the system keeps for it. `CPU` is the time that the processor worked: "
        "where it is far below the time on the wall, other programs or the disk had their turn.",
        "",
        "| step | seconds | CPU seconds | peak memory, GB | load of the machine |",
        "|---|---|---|---|---|",
    ]
    for step, name in NAMES.items():
        row = results[step]
        lines.append(
            f"| {name} | {row['seconds']:.1f} | {row['cpu_seconds']:.1f} | "
            f"{row['peak'] / 1e9:.2f} | {row['load']:.1f} |"
        )
    sections = facts(frames, results), on_paper(frames, results), limits()
    return "\n".join([*lines, *(text for section in sections for text in ("", *section)), ""])


def facts(frames: int, results: dict[str, dict[str, Any]]) -> list[str]:
    half, index, built = results["float16"], results["ivfpq"], results["build"]
    real = results["drives"]
    return [
        f"- {results['write']['bytes'] / frames:.0f} bytes a frame on the disk, all told.",
        f"- One query alone takes {results['memory']['one'] * 1e3:.0f} ms of CPU in memory, "
        f"{results['float32']['one'] * 1e3:.0f} ms memory-mapped.",
        f"- In half precision {half['agreement']:.3f} of the queries have the same best match as "
        f"in single; no best score is further off than {half['off']:.1e}.",
        f"- The index has {built['lists']} lists, of which {built['probes']} are looked through, "
        f"and {built['bytes'] / frames:.0f} bytes a frame. Of the exact best it found "
        f"{built['recall_at']['1']:.3f} at 1 and {built['recall_at']['10']:.3f} at 10 when built; "
        f"{index['agreement']:.3f} of the {QUERIES} queries have the exact best match. The "
        "frames here are denser than real ones: many are mixtures of the same few.",
        f"- On real drives (CamVid, odd frames against even, {real['queries']} queries) Recall@1 "
        f"is {real['float32']:.4f} in single precision and {real['float16']:.4f} with references "
        "in half.",
    ]


def on_paper(frames: int, results: dict[str, dict[str, Any]]) -> list[str]:
    """What other numbers of frames need, by the unit costs measured above."""
    disk = results["write"]["bytes"] / frames
    search = results["memory"]["cpu_seconds"] / QUERIES / frames
    alone = results["memory"]["one"] / frames
    known = (results["reopen"]["peak"] - results["nothing"]["peak"]) / frames
    code = results["build"]["bytes"] / frames
    encode = results["drives"]["frame"]
    lines = [
        "## On paper",
        "",
        f"From the unit costs above, and {1e3 * encode:.1f} ms of one core to read and encode a "
        "label map of CamVid (measured here too):",
        "",
        "| | 1 million | 100 million | 10 billion |",
        "|---|---|---|---|",
    ]
    rows: dict[str, Callable[[float], str]] = {
        "encode, core hours": lambda n: f"{n * encode / 3600:,.1f}",
        "encode in a night of 10 h, cores": lambda n: f"{max(1, np.ceil(n * encode / 36000)):,.0f}",
        "database on the disk": lambda n: amount(n * disk),
        "what a second run of `encode` holds of the ids": lambda n: amount(n * known),
        "descriptors in memory, float32": lambda n: amount(n * 1920),
        "descriptors memory-mapped, float16": lambda n: amount(n * 960),
        "one exact query of a thousand at once, core seconds": lambda n: f"{n * search:,.3f}",
        "one exact query alone, core seconds": lambda n: f"{n * alone:,.1f}",
        "index of faiss in memory": lambda n: amount(n * code),
        "parts, and entries of the manifest": lambda n: f"{np.ceil(n / PART_ROWS):,.0f}",
    }
    for name, value in rows.items():
        lines.append(f"| {name} | {' | '.join(value(n) for n in (1e6, 1e8, 1e10))} |")
    return lines


def limits() -> list[str]:
    return [
        "Where the design stops:",
        "",
        "- **A million** is one machine of any kind: everything in memory, exact.",
        "- **A hundred million** is one large machine. Encoding wants several machines (`--engine "
        "ray`) or many nights. Exact search is then for a batch of queries, not for one in a "
        "hurry; the index of product-quantised codes fits in memory and the descriptors it is "
        "scored anew with stay on the disk. The manifest is written anew with every part, so that "
        "what is written of it grows with the square of their number (some megabytes each time by "
        "then; parts of 65 536 rows instead of 4096 put it right), and a second run of `encode` "
        "holds every id in memory.",
        "- **Ten billion** is beyond one database: ids no longer fit in memory, one manifest no "
        "longer names all parts. It is a hundred databases of a hundred million, by region, each "
        "with its index on a machine of its own, asked all at once, their candidates merged by "
        "score: scores of one fingerprint compare. With codes of 30 bytes instead of 60 they are "
        "less than half a terabyte in memory in all. Nothing of this kind is in this package: a "
        "database is a shard, and what asks shards lies above it.",
    ]


def amount(size: float) -> str:
    units = ["B", "kB", "MB", "GB", "TB"]
    while size >= 1000 and len(units) > 1:
        size /= 1000
        del units[0]
    return f"{size:.3g} {units[0]}"


if __name__ == "__main__":
    main()
