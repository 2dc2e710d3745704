#!/usr/bin/env python3
"""Writes docs/scale.md: time and memory of a database of a million frames and more.

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
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sized
from pathlib import Path
from typing import Any

import _large_maps
import numpy as np
import torch
from _markdown import Page, head_row, row

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, match
from ssrvlad_torch.channels.signs import REACH
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.encoding.plan import COMMIT_ROWS
from ssrvlad_torch.native.decide import follow
from ssrvlad_torch.recognition.comparison import ReferenceRows
from ssrvlad_torch.recognition.matching import Rows
from ssrvlad_torch.recognition.sequences import runs
from ssrvlad_torch.recognition.sweep import COLUMNS, score
from ssrvlad_torch.search.coarse_index import build
from ssrvlad_torch.stages.features import SHAPE

LABELS_AS = "cityscapes-trainids"
SEEDS, FRAMES_OF_A_SEED, FRAMES_OF_A_SEQUENCE = 4, 64, 10_000
BACK, ONLINE = 3000, 20
QUERIES, ALONE, NOISE, ON_PAPER = 1000, 5, 0.15, 100_000_000

Report = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, action="append", help="repeatable; one million")
    parser.add_argument("--folder", type=Path, default=Path("scale"), help="of the databases")
    parser.add_argument("--out", type=Path, default=Path("docs/scale.md"))
    parser.add_argument("--signs", action="store_true", help="measure search by features alone")
    parser.add_argument("--pictures", action="store_true", help="measure all channels alone")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    sizes = given.frames or [1_000_000]
    if given.step:
        print(json.dumps(measured(STEPS[given.step][1], sizes[0], given.folder)))
        return
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.pictures:
        steps = [*_large_maps.STEPS]
    else:
        steps = (
            ["signs"] if given.signs else [name for name in STEPS if name not in _large_maps.STEPS]
        )
    results = {frames: run_all(frames, given.folder, steps) for frames in sizes}
    page = Page("scale.md", given.out, not (given.pictures or given.signs))
    if given.pictures:
        page.section("## Pictures by all channels", _large_maps.in_words(results))
        page.section("## Drives by all channels", _large_maps.drives_in_words(results))
        return
    if not given.signs:
        fill(page, results)
    frames = max(results)
    page.section("## Search by features", by_features(frames, results[frames]["signs"]))


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


def online(frames: int, folder: Path) -> Report:
    """The exact search of a frame, from one anchor and from those of a sweep, and following on top
    of it, in seconds of CPU. What `follow` does once for a map counts in none."""
    references = opened(frames, folder).load()
    known, wanted = Rows.of(references.descriptors), again(folder)[:ONLINE]
    starts = [run.start for run in runs(references.sequences)]
    times = [time.process_time()]
    scores = torch.cat([score(query[None], known) for query in wanted])
    times.append(time.process_time())
    for part in (scores[:1], scores):
        follow(part.numpy(), starts, len(known), "online", top=1)
        times.append(time.process_time())
    for query in wanted[:ALONE]:
        score(query.expand(1, len(COLUMNS), -1), known)
    times.append(time.process_time())
    search, first, all_of_them, swept = np.diff(times).tolist()
    follows = (all_of_them - first) / (ONLINE - 1)
    return {"search": search / ONLINE, "follow": follows, "swept": swept / ALONE}


def opened(frames: int, folder: Path) -> Database:
    return Database.open(folder / f"{frames}.ssrdb")


def signs(frames: int, _folder: Path) -> Report:
    """The exact search of a frame by features and by descriptors, in seconds of CPU. They are all
    random, for times do not depend on values."""
    drawn = torch.Generator().manual_seed(0)
    stored = torch.randint(256, (frames, *SHAPE), dtype=torch.uint8, generator=drawn)
    rows, times = ReferenceRows(stored, [""] * frames), []
    for number in range(ALONE):
        began = time.process_time()
        scores = rows.compare(stored[number : number + 1], False, True).whole()
        times.append(time.process_time() - began)
        assert int(scores.argmax()) == number
    report = {"features": float(np.median(times))}
    del stored, rows
    vectors = torch.randn(frames, 480, generator=drawn)
    known = Rows.of(vectors.div_(vectors.norm(dim=1, keepdim=True)))
    for name, anchors in (("one", 1), ("swept", len(COLUMNS))):
        times = []
        for query in vectors[:ALONE]:
            began = time.process_time()
            score(query.expand(1, anchors, -1), known)
            times.append(time.process_time() - began)
        report[name] = float(np.median(times))
    return report


def queries(folder: Path) -> torch.Tensor:
    return varied(0, QUERIES, seeds(folder).flip(0))


def again(folder: Path) -> torch.Tensor:
    """Consecutive frames of the database with other noise."""
    numbers = varied(0, COMMIT_ROWS, seeds(folder))[BACK : BACK + QUERIES]
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(numbers.shape, generator=generator) * numbers.abs().mean(1, keepdim=True)
    return torch.nn.functional.normalize(numbers + NOISE * noise * (numbers != 0), dim=1)


STEPS: dict[str, tuple[str, Callable[[int, Path], Report]]] = {
    "nothing": ("import", lambda _frames, _folder: {}),
    "write": (f"write, {COMMIT_ROWS} frames a commit", write),
    "compact": ("`db compact`", compact),
    "known": ("read all records", reads(Database.known)),
    "verify": ("`db verify`", verify),
    "load": ("load and verify", reads(Database.load)),
    "exact": (f"{QUERIES} exact queries", exact),
    "index": ("`db index`", index),
    "online": ("", online),
    "signs": ("", signs),
    **{name: ("", step) for name, step in _large_maps.STEPS.items()},
}
"""Names in the table, empty for those that are not in it, and functions."""


def fill(page: Page, results: dict[int, dict[str, Report]]) -> None:
    """Writes what was measured; the page has a section for each number of frames."""
    where = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
    page.paragraph("Written by", f"Written by `scripts/pages/scale.py` on {where}.")
    for frames, reports in results.items():
        page.section(f"## {frames:,} frames", [*table(reports), "", *facts(frames, reports)])
    frames = max(results)
    page.paragraph(
        "The costs per frame among",
        f"The costs per frame among {frames:,}, times {ON_PAPER:,}. Writing will take longer than "
        "this, because each commit looks up the ids that exist.",
    )
    page.table("frames, extrapolated\n", on_paper(frames, results[frames]))


def table(reports: dict[str, Report]) -> Iterator[str]:
    yield from head_row("step", "s", "CPU s", "peak GB")
    for step, (name, _) in STEPS.items():
        if name:
            of = reports[step]
            yield row(name, f"{of['seconds']:.1f}", f"{of['cpu']:.1f}", f"{of['peak'] / 1e9:.2f}")


def facts(frames: int, reports: dict[str, Report]) -> list[str]:
    exact, built = reports["exact"], reports["index"]["bytes"]
    search, more, swept = (reports["online"][key] for key in ("search", "follow", "swept"))
    return [
        f"- On disk: {reports['compact']['bytes'] / frames:.0f} bytes a frame, and "
        f"{built / frames:.0f} of the index.",
        f"- A single query takes {exact['one'] * 1e3:.0f} ms of CPU with exact search by `match` "
        "(lengths of all rows, cosines, the best 10).",
        f"- Online with exact search, the CPU time of a frame is {search * 1e3:.0f} ms for the "
        f"search (cosines alone; lengths are known) and {more * 1e3:.0f} ms for following, "
        f"{1 + more / search:.2f} times the search alone. With a sweep of {len(COLUMNS)} "
        f"anchors, the search takes {swept * 1e3:.0f} ms; search and following take "
        f"{1 + more / swept:.2f} times that.",
    ]


def by_features(frames: int, report: Report) -> Iterator[str]:
    yield (
        f"{frames:,} frames, one query alone, all in one process of one thread, medians of {ALONE};"
        " the values are random, because times do not depend on them. Descriptors are searched as "
        "online, by cosines alone; compare these times with each other only. Load of the machine: "
        f"{report['load']:.0f}.\n"
    )
    yield from head_row("exact search by", "bytes a frame", "CPU ms a query")
    for name, by, size in (
        ("features", f"features, {2 * REACH + 1} moves", np.prod(SHAPE)),
        ("one", "descriptors, one anchor", 1920),
        ("swept", f"descriptors, a sweep of {len(COLUMNS)} anchors", 1920),
    ):
        yield row(by, str(size), f"{report[name] * 1e3:.0f}")


def on_paper(frames: int, reports: dict[str, Report]) -> Iterator[str]:
    """Costs of a hundred million frames, extrapolated from those per frame."""
    many = ON_PAPER / frames
    cpu = {step: report["cpu"] * many for step, report in reports.items()}
    held = (reports["known"]["peak"] - reports["nothing"]["peak"]) * many
    yield from head_row("what", "amount")
    yield row("database on disk", f"{reports['compact']['bytes'] * many / 1e9:,.0f} GB")
    yield row("writing, core hours", f"{cpu['write'] / 3600:,.1f}")
    yield row("verifying, core hours", f"{cpu['verify'] / 3600:,.1f}")
    yield row("records in the memory of a second run of `encode`", f"{held / 1e9:,.0f} GB")
    yield row("descriptors in memory", f"{1920 * ON_PAPER / 1e9:,.0f} GB")
    one_of_many = "an exact query, one of a thousand at once, core seconds"
    yield row(one_of_many, f"{cpu['exact'] / QUERIES:,.2f}")
    yield row("an exact query alone, core seconds", f"{reports['exact']['one'] * many:,.1f}")
    yield row("building the index, core hours", f"{cpu['index'] / 3600:,.1f}")


if __name__ == "__main__":
    main()
