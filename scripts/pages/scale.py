#!/usr/bin/env python3
"""Writes docs/evaluation/scale-pictures.csv, scale-drives.csv and scale-labels.csv: large maps.

    .venv/bin/python scripts/pages/scale.py --frames 100000 --folder /data

Real rows stand among made-up ones of their statistics. A made-up row is made of three real ones,
patch by patch of the picture: label shapes category by category, with noise, and with every
sixteenth sign of features changed. Every step runs in a new process with one thread, so that its
memory and its time are not mixed with others. Results stay in the folder, and a second run resumes.
The script needs ten kilobytes a frame on disk and, for exact search, eight in memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from _described import FEATURES, OURS, Described
from _markdown import ROOT, Page
from _scale_tables import Report, drives, label_maps, pictures
from torch import Tensor

from ssrvlad_torch import Database, SSRVLADConfig, match
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.database.frames import FrameRecord, FrameSet
from ssrvlad_torch.native.headers import model
from ssrvlad_torch.native.map import DescriptorMap
from ssrvlad_torch.recognition.matching import cosines, unit_queries
from ssrvlad_torch.recognition.recognise import Recognised, Steps, references_of
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.search.exact import chosen_channels, recognise_in
from ssrvlad_torch.search.index import build, read_rows
from ssrvlad_torch.search.shortlist import Shortlist
from ssrvlad_torch.stages.features import FORM

CONFIG = SSRVLADConfig.from_preset("default", labels_as="cityscapes-trainids")
DATA, NETWORK = ROOT.parent / "shared" / "data", "espnetv2"
REFERENCES = ("uofa/day", "gardens_walk/day_left")
QUERIES = ("uofa/evening", "gardens_walk/day_right", "gardens_walk/night_right")
EVERY, AT_ONCE, BLOCK, TOP = 4, 30, 1 << 13, 5
MOST_IN_MEMORY = 100_000
NOISE, PATCHES = 0.15, 4

Channels = dict[str, Tensor]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, action="append", help="repeatable; 100,000")
    parser.add_argument("--folder", type=Path, default=Path("scale"), help="of the databases")
    parser.add_argument("--output", type=Path, default=Path("docs/evaluation/speed.md"))
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    sizes = options.frames or [100_000]
    if options.step:
        print(json.dumps(measured(STEPS[options.step], sizes[0], options.folder)))
        return
    options.folder.mkdir(parents=True, exist_ok=True)
    results = {frames: run_all(frames, options.folder) for frames in sizes}
    page = Page("evaluation/speed.md", options.output)
    page.table("scale-pictures", pictures(results))
    page.table("scale-drives", drives(results, QUERIES))
    page.table("scale-labels", label_maps(results))


def run_all(frames: int, folder: Path) -> dict[str, Report]:
    """The reports of steps; those of an earlier run are read."""
    done = folder / f"{frames}.json"
    reports: dict[str, Report] = json.loads(done.read_text()) if done.exists() else {}
    for step in STEPS:
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


def described(folder: Path, drives: Sequence[str], every: int = 1) -> Channels:
    """The descriptors of real drives by channel, cached in a folder; of label maps from all
    anchors."""
    source = Described(DATA, folder / "cache")
    return {
        name: torch.cat([source.vectors(f"real {NETWORK} {d}", method)[::every] for d in drives])
        for name, method in (("ssr-vlad", OURS), ("features", FEATURES), ("hog", "HOG"))
    }


def real_rows(folder: Path) -> Channels:
    """The descriptors of the references, of label maps from the usual anchor."""
    found = described(folder, REFERENCES)
    return {**found, "ssr-vlad": found["ssr-vlad"][:, COLUMNS.index(0)]}


def made_up(first: int, count: int, real: Channels) -> Channels:
    """``count`` rows of the statistics of real ones."""
    drawn = np.random.default_rng(first)
    signs, hog, shapes = (real[name].numpy() for name in ("features", "hog", "ssr-vlad"))
    sources = drawn.integers(0, len(signs), (count, 3))

    def chosen(*shape: int) -> np.ndarray:
        parts = drawn.integers(0, 3, (count, int(np.prod(shape))))
        return np.take_along_axis(sources, parts, 1).reshape(count, *shape)

    patches, columns, rows = chosen(PATCHES, PATCHES), *map(np.arange, signs.shape[1:3])
    of = patches[:, columns * PATCHES // len(columns)][:, :, rows * PATCHES // len(rows)]
    mixed = signs[of, columns[:, None], rows]
    changed = drawn.integers(0, 256, (4, *mixed.shape), np.uint8)
    mixed ^= np.bitwise_and.reduce(changed)
    down, across = np.arange(6), np.arange(10)
    of = patches[:, across * PATCHES // 10][:, :, down * PATCHES // 6].transpose(0, 2, 1)
    gradients = hog.reshape(-1, 6, 10, 8)[of, down[:, None], across].reshape(count, -1)
    areas = shapes.reshape(-1, 8, shapes.shape[1] // 8)[chosen(8), np.arange(8)]
    vectors = {"hog": gradients, "ssr-vlad": areas.reshape(count, -1)}
    for name, values in vectors.items():
        noise = drawn.standard_normal(values.shape, np.float32)
        noise *= NOISE * np.abs(values).mean(1, keepdims=True) * (values != 0)
        vectors[name] = values + noise
    vectors["hog"] = np.abs(vectors["hog"])
    tensors = {
        name: torch.from_numpy(values.astype(np.float32)) for name, values in vectors.items()
    }
    units = {name: torch.nn.functional.normalize(each, dim=1) for name, each in tensors.items()}
    return {**units, "features": torch.from_numpy(mixed)}


def path_of(frames: int, folder: Path, kind: str = "pictures") -> Path:
    """Where the database of so many frames is."""
    return folder / f"{frames}.{kind}.ssrdb"


def opened(frames: int, folder: Path, kind: str = "pictures") -> Database:
    """The database of so many frames."""
    return Database.open(path_of(frames, folder, kind))


def bytes_of(path: Path) -> int:
    """What a database takes on disk."""
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def write(frames: int, folder: Path) -> Report:
    """The real references, and made-up rows up to the number of frames."""
    real, path = real_rows(folder), path_of(frames, folder)
    columns = [Features(FORM).column, HOG().column]
    database = Database.open_or_create(path, CONFIG, columns)
    known = len(real["hog"])
    if not len(database):
        database.append([FrameRecord("real", f"{n:07d}", n, 0.0) for n in range(known)], real)
    for first in range(len(database), frames, BLOCK):
        count = min(BLOCK, frames - first)
        records = [
            FrameRecord(f"made-{n // 5000:04d}", f"{n:07d}", float(n), 0.0)
            for n in range(first, first + count)
        ]
        database.append(records, made_up(first, count, real))
    database.compact(keep_days=0)
    return {"bytes": bytes_of(path), "real": known}


def write_labels(frames: int, folder: Path) -> Report:
    """The label maps of these rows in a database of their own, as `encode` commits them."""
    path = path_of(frames, folder, "labels")
    pictures, labels = opened(frames, folder), Database.open_or_create(path, CONFIG)
    known, stored = pictures.placed()
    begun, cpu = len(labels), 0.0
    for first in range(begun, frames, BLOCK):
        part = slice(first, first + BLOCK)
        vectors = read_rows(pictures, stored[part], labels.columns)
        spent = time.process_time()
        labels.append(known.frames[part], vectors)
        cpu += time.process_time() - spent
    labels.compact(keep_days=0)
    return {"bytes": bytes_of(path), "cpu": cpu * frames / (frames - begun)}


def verify_labels(frames: int, folder: Path) -> Report:
    """Every row of label maps."""
    assert not opened(frames, folder, "labels").damage()
    return {}


def search_labels(frames: int, folder: Path) -> Report:
    """Label maps in memory, searched by all queries at once, and by some alone."""
    queries = described(folder, QUERIES)["ssr-vlad"][:, COLUMNS.index(0)]
    began = time.process_time()
    references = opened(frames, folder, "labels").load().descriptors
    loaded = time.process_time()
    match(queries, references, TOP)
    searched = time.process_time()
    for query in queries[:AT_ONCE]:
        match(query[None], references, TOP)
    alone = time.process_time() - searched
    at_once = (searched - loaded) / len(queries)
    return {"loading": loaded - began, "at once": at_once, "one": alone / AT_ONCE}


def index(frames: int, folder: Path) -> Report:
    """The index."""
    return {"bytes": build(opened(frames, folder)).bytes}


def alone(frames: int, folder: Path) -> Report:
    """Each query alone by the index, warm: the second of two passes."""
    queries, began = described(folder, QUERIES, EVERY), time.process_time()
    database = opened(frames, folder)
    channels = chosen_channels(database)
    shortlist = Shortlist(database, channels)
    opening, times, first = time.process_time() - began, list[float](), list[int]()
    for _ in range(2):
        times, first = [], []
        for number in range(len(queries["hog"])):
            one = {name: values[number : number + 1] for name, values in queries.items()}
            began = time.process_time()
            found = recognise_in(shortlist, as_queries(one), channels, Steps(follow=None), TOP)
            times.append(time.process_time() - began)
            first.append(int(found.matches.indices[0, 0]))
    return {"opening": opening, "one": float(np.median(times)), "first": first}


@torch.no_grad()
def exact(frames: int, folder: Path) -> Report:
    """The first answer to each query alone by exact search, some queries at once, from disk."""
    database, queries = opened(frames, folder), described(folder, QUERIES, EVERY)
    channels = {channel.column.name: channel for channel in chosen_channels(database)}
    trust = {name: channel.trust for name, channel in channels.items()}
    town = DescriptorMap([frames])
    for name, of in trust.items():
        town.add(name, None, of)
    columns = [channel.column for channel in channels.values()]
    _, stored = database.placed()
    first, reaches = list[int](), sorted({abs(column) for column in COLUMNS})
    for start in range(0, len(queries["hog"]), AT_ONCE):
        some = {name: values[start : start + AT_ONCE] for name, values in queries.items()}
        count = len(some["hog"])
        signs, hog = torch.empty(count, frames), torch.empty(count, frames)
        shapes = torch.empty(len(reaches), count, frames)
        anchors = unit_queries(some["ssr-vlad"]).flatten(0, 1)
        for at in range(0, frames, BLOCK):
            part = slice(at, at + BLOCK)
            known = read_rows(database, stored[part], columns)
            rows = references_of({"features": known["features"]}, [""] * len(known["features"]))
            scores, _ = rows.compare({"features": some["features"].numpy()}, sweep=True)
            signs[:, part] = torch.from_numpy(scores)
            hog[:, part] = cosines(unit_queries(some["hog"]), known["hog"])
            each = cosines(anchors, known["ssr-vlad"]).view(count, len(COLUMNS), -1)
            for number, reach in enumerate(reaches):
                inside = [abs(column) <= reach for column in COLUMNS]
                shapes[number, :, part] = each[:, inside].amax(1)
        for query in range(count):
            widest = shapes[int(np.argmax([lead(scores[query]) for scores in shapes])), query]
            parts = {"features": signs[query], "hog": hog[query], "ssr-vlad": widest}
            together, _ = town.compare({name: parts[name][None].numpy() for name in trust})
            first.append(int(together.argmax()))
    return {"first": first}


def lead(scores: Tensor) -> float:
    """How much nearer the nearest row is than the nearest elsewhere."""
    near = -(1 - scores).clamp(min=1e-6).log()
    elsewhere = (torch.arange(len(near)) - near.argmax()).abs() > model("Place")["elsewhere"]
    return float(near.max() - near[elsewhere].max())


def drive_of(folder: Path, name: str) -> FrameSet:
    """The frames of a real drive, as queries."""
    return as_queries(described(folder, [name]))


def as_queries(found: Channels) -> FrameSet:
    """Descriptors as frames of one sequence."""
    count, unknown = len(found["hog"]), np.full((len(found["hog"]), 3), np.nan)
    ids = tuple(f"drive/{number:04d}" for number in range(count))
    return FrameSet(ids, ("drive",) * count, found, unknown, unknown[:, 0], np.zeros(count, bool))


def told(found: Recognised, seconds: float) -> Report:
    """What is kept of the answers to a drive."""
    return {
        "rate": len(found.confidence) / seconds,
        "first": found.matches.indices[:, 0].tolist(),
        "confidence": found.confidence.tolist(),
        "followed": found.used["follow"]["drive"],
    }


def followed(frames: int, folder: Path) -> Report:
    """Each drive by the index, warm: the second of two times."""
    database, report = opened(frames, folder), {}
    channels = chosen_channels(database)
    shortlist = Shortlist(database, channels)
    for name in QUERIES:
        queries = drive_of(folder, name)
        for _ in range(2):
            began = time.process_time()
            found = recognise_in(shortlist, queries, channels, Steps(), TOP)
            report[name] = told(found, time.process_time() - began)
    return report


def followed_exactly(frames: int, folder: Path) -> Report:
    """Each drive by exact search in memory, where so many frames fit."""
    if frames > MOST_IN_MEMORY:
        return {}
    database, report = opened(frames, folder), {}
    references, channels = database.load(), chosen_channels(database)
    for name in QUERIES:
        queries, began = drive_of(folder, name), time.process_time()
        found = recognise_in(references, queries, channels, Steps(), TOP)
        report[name] = told(found, time.process_time() - began)
    return report


STEPS: dict[str, Callable[[int, Path], Report]] = {
    "pictures": write,
    "coarse": index,
    "alone": alone,
    "together": exact,
    "drives": followed,
    "drives together": followed_exactly,
    "labels": write_labels,
    "labels verified": verify_labels,
    "labels searched": search_labels,
}


if __name__ == "__main__":
    main()
