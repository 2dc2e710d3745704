#!/usr/bin/env python3
"""Writes docs/evaluation/scale.csv: time and memory of a database of a million frames and more.

    .venv/bin/python scripts/pages/scale.py --frames 1000000 --frames 4000000 --folder /data

Every step runs in a new process with one thread, so that its memory and its time are not mixed with
others. The descriptors are made from those of the synthetic city: parts of two of them, and noise.
Results stay in the folder, and a second run resumes. The script needs two kilobytes a frame on disk
and the same in memory. A million frames take about ten minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sized
from itertools import product
from pathlib import Path
from typing import Any

import _large_maps
import numpy as np
import torch
from _markdown import Page, head_row, row

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, match
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.encoding.plan import COMMIT_ROWS
from ssrvlad_torch.search.index import build

LABELS_AS = "cityscapes-trainids"
SEEDS, FRAMES_OF_A_SEED, FRAMES_OF_A_SEQUENCE = 4, 64, 10_000
QUERIES, ALONE, NOISE = 1000, 5, 0.15

Report = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, action="append", help="repeatable; one million")
    parser.add_argument("--folder", type=Path, default=Path("scale"), help="of the databases")
    parser.add_argument("--out", type=Path, default=Path("docs/evaluation/speed.md"))
    parser.add_argument("--pictures", action="store_true", help="measure all channels alone")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    sizes = given.frames or [1_000_000]
    if given.step:
        print(json.dumps(measured(STEPS[given.step][1], sizes[0], given.folder)))
        return
    given.folder.mkdir(parents=True, exist_ok=True)
    steps = [name for name in STEPS if (name in _large_maps.STEPS) == given.pictures]
    results = {frames: run_all(frames, given.folder, steps) for frames in sizes}
    page = Page("evaluation/speed.md", given.out)
    if given.pictures:
        page.table("scale-pictures", _large_maps.pictures(results))
        page.table("scale-drives", _large_maps.drives(results))
    else:
        page.table("scale", table(results))


def run_all(frames: int, folder: Path, steps: list[str]) -> dict[str, Report]:
    """The reports of steps; those of an earlier run are read."""
    done = folder / f"{frames}.json"
    reports: dict[str, Report] = json.loads(done.read_text()) if done.exists() else {}
    for step in steps:
        if step not in reports:
            command = [sys.executable, __file__, "--step", step, "--folder", str(folder)]
            command += ["--frames", str(frames)]
            environment = {**os.environ, "OMP_NUM_THREADS": "1", "LANCE_LOG": "error"}
            process = subprocess.run(
                command, stdout=subprocess.PIPE, text=True, check=True, env=environment
            )
            reports[step] = json.loads(process.stdout.splitlines()[-1])
            done.write_text(json.dumps(reports))
            print(frames, step, reports[step], file=sys.stderr, flush=True)
    return reports


def measured(step: Callable[[int, Path], Report], frames: int, folder: Path) -> Report:
    """The report of a step with its time, its peak memory, and the load of the machine."""
    began, spent = time.perf_counter(), time.process_time()
    report = step(frames, folder)
    report.setdefault("seconds", time.perf_counter() - began)
    report.setdefault("cpu", time.process_time() - spent)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {**report, "peak": peak, "load": os.getloadavg()[0]}


def seeds(folder: Path) -> torch.Tensor:
    """``(S, D)`` descriptors of frames of synthetic cities, cached."""
    file = folder / "seeds.npy"
    if not file.exists():
        head = SSRVLAD.from_preset("default", labels_as=LABELS_AS)
        found = []
        for seed in range(SEEDS):
            frames = SyntheticCity(seed).traverse(FRAMES_OF_A_SEED, labels_as=LABELS_AS)
            labels = torch.from_numpy(np.stack([frame.labels for frame in frames]))
            found += [head(batch) for batch in labels.split(16)]
        np.save(file, torch.cat(found).numpy())
    return torch.from_numpy(np.load(file))


def varied(first: int, count: int, basis: torch.Tensor) -> torch.Tensor:
    """``(count, D)`` descriptors: of two frames, category by category, and noise where they have
    any."""
    generator = torch.Generator().manual_seed(first)
    one, other = (torch.randint(len(basis), (count,), generator=generator) for _ in range(2))
    chosen = torch.rand(count, 8, generator=generator).lt(0.5)
    taken = chosen.repeat_interleave(basis.shape[1] // 8, 1)
    numbers = torch.where(taken, basis[one], basis[other])
    scale = NOISE * numbers.abs().mean(dim=1, keepdim=True)
    noise = torch.randn(numbers.shape, generator=generator) * scale
    return torch.nn.functional.normalize(numbers + noise * (numbers != 0), dim=1)


def records(first: int, count: int) -> list[FrameRecord]:
    return [
        FrameRecord(
            f"drive-{n // FRAMES_OF_A_SEQUENCE:06d}", f"{n % FRAMES_OF_A_SEQUENCE:06d}",
            float(n), 0.0, 0.0, n / 10, f"/data/drives/{n // FRAMES_OF_A_SEQUENCE}|3500 {n} {n}",
            f"{n:032x}", 240, 320,
        )
        for n in range(first, first + count)
    ]  # fmt: skip


def write(frames: int, folder: Path) -> Report:
    """Frames as `encode` commits them, each commit on the disk before the next."""
    basis, path = seeds(folder), folder / f"{frames}.ssrdb"
    config = SSRVLADConfig.from_preset("default", labels_as=LABELS_AS)
    database = Database.open_or_create(path, config)
    seconds = cpu = 0.0
    written = len(database)  # of a run that was ended
    for first in range(written, frames, COMMIT_ROWS):
        count = min(COMMIT_ROWS, frames - first)
        numbers, rows = varied(first, count, basis), records(first, count)
        began, spent = time.perf_counter(), time.process_time()
        database.merge(rows, numbers)
        seconds, cpu = seconds + time.perf_counter() - began, cpu + time.process_time() - spent
    share = frames / (frames - written) if written < frames else 1
    return {"seconds": seconds * share, "cpu": cpu * share}


def compact(frames: int, folder: Path) -> Report:
    opened(frames, folder).compact(keep_days=0)
    files = (file for file in (folder / f"{frames}.ssrdb").rglob("*") if file.is_file())
    return {"bytes": sum(file.stat().st_size for file in files)}


def reads(every: Callable[[Database], Sized]) -> Callable[[int, Path], Report]:
    """The step that reads something of every frame."""

    def step(frames: int, folder: Path) -> Report:
        assert len(every(opened(frames, folder))) == frames
        return {}

    return step


def verify(frames: int, folder: Path) -> Report:
    assert opened(frames, folder).damage() == []
    return {}


def exact(frames: int, folder: Path) -> Report:
    references, wanted = opened(frames, folder).load().descriptors, queries(folder)
    began, spent = time.perf_counter(), time.process_time()
    match(wanted, references, 10)
    seconds, cpu = time.perf_counter() - began, time.process_time() - spent
    spent = time.process_time()
    for query in wanted[:ALONE]:
        match(query[None], references, 10)
    return {"seconds": seconds, "cpu": cpu, "one": (time.process_time() - spent) / ALONE}


def index(frames: int, folder: Path) -> Report:
    return {"bytes": build(opened(frames, folder)).bytes}


def opened(frames: int, folder: Path) -> Database:
    return Database.open(folder / f"{frames}.ssrdb")


def queries(folder: Path) -> torch.Tensor:
    return varied(0, QUERIES, seeds(folder).flip(0))


STEPS: dict[str, tuple[str, Callable[[int, Path], Report]]] = {
    "nothing": ("import", lambda _frames, _folder: {}),
    "write": (f"write, {COMMIT_ROWS} frames a commit", write),
    "compact": ("`db compact`", compact),
    "known": ("read all records", reads(Database.known)),
    "verify": ("`db verify`", verify),
    "load": ("load and verify", reads(Database.load)),
    "exact": (f"{QUERIES} exact queries", exact),
    "index": ("`db index`", index),
    **{name: ("", step) for name, step in _large_maps.STEPS.items()},
}
"""Names in the table, empty for those that are not in it, and functions."""


def table(results: dict[int, dict[str, Report]]) -> Iterator[str]:
    """A row for each number of frames and step; what is on disk after it, where it writes."""
    yield from head_row("frames", "step", "s", "CPU s", "peak GB", "bytes a frame")
    for (frames, reports), (step, (name, _)) in product(results.items(), STEPS.items()):
        if name:
            of = reports[step]
            size = f"{of['bytes'] / frames:.0f}" if "bytes" in of else ""
            numbers = f"{of['seconds']:.1f}", f"{of['cpu']:.1f}", f"{of['peak'] / 1e9:.2f}"
            yield row(f"{frames:,}", name, *numbers, size)
            if "one" in of:
                yield row(f"{frames:,}", "one exact query", "", f"{of['one']:.3f}", "", "")


if __name__ == "__main__":
    main()
