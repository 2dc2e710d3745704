#!/usr/bin/env python3
"""Writes docs/benchmark.md: time and memory of the method, in one run.

    .venv/bin/python scripts/pages/benchmark.py --camvid ../shared/data/camvid \
        --networks ../shared/data/networks

The rows of a table are timed in turn (`_timing.time_in_turn`) with a fixed number
of threads. Label maps are those of CamVid, enlarged to each size, or without it of the synthetic
city. Needs the extra `dev`; `pip install faiss-cpu` adds the comparison of matching.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.fft
import torch
from _encoding_costs import encoding_table
from _loops_cost import loops_table
from _markdown import Page, head_row, paragraph, row, save, span
from _opencv import opencv_describe
from _picture_costs import pictures_table
from _timing import Timing, heads, onnx_head, threads, time_in_turn
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, match, reference
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.recognition.comparison import ReferenceRows
from ssrvlad_torch.stages.features import SHAPE

SIZES = [(512, 512), (1024, 1024)]
LARGE = (1024, 1024)
BATCH = 16
EVERY_BUFFER_GIVEN_BACK = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
SPECKS = [0, 1000, 10_000]
SIGN_QUERIES = 20


class Maps:
    """Label maps of any size: CamVid's, enlarged, or the synthetic city's."""

    def __init__(self, camvid: Path | None) -> None:
        self.labels_as = "camvid-11" if camvid else "cityscapes-trainids"
        self.source = "CamVid labels, enlarged" if camvid else "the synthetic city"
        self.files = sorted(camvid.glob("*/labels/*.png"))[::26][:BATCH] if camvid else []

    def batch(self, size: tuple[int, int], count: int) -> Tensor:
        """``(count, H, W)`` uint8."""
        if self.files:
            files = self.files[:count]
            images = [Image.open(file).resize(size[::-1], Image.NEAREST) for file in files]
            return torch.from_numpy(np.stack([np.asarray(image) for image in images]))
        frames = SyntheticCity(seed=0).traverse(count, size=size, labels_as=self.labels_as)
        return torch.from_numpy(np.stack([frame.labels for frame in frames]))

    def config(self, preset: str) -> SSRVLADConfig:
        return SSRVLADConfig.from_preset(preset, labels_as=self.labels_as)


def ways_of(maps: Maps, preset: str, labels: Tensor) -> dict[str, Callable[[], object]]:
    """Every way to describe one image; their results must agree before they are timed."""
    config, image = maps.config(preset), labels[0].numpy()
    ways: dict[str, Callable[[], Any]] = {"reference": partial(reference.describe, image, config)}
    if preset == "paper":
        ways["OpenCV, layer by layer"] = partial(opencv_describe, image, config)
    for name, head in heads(config).items():
        ways[f"module, {name}"] = partial(head, labels[:1])
    ways["ONNX Runtime"] = partial(onnx_head(config), labels[:1])
    if torch.cuda.is_available():
        ways["module, CUDA"] = partial(SSRVLAD(config).to("cuda"), labels[:1].to("cuda"))
    answers = {name: np.ravel(torch.as_tensor(way()).cpu()) for name, way in ways.items()}
    for name, answer in answers.items():
        worst = float(np.abs(answer - answers["reference"]).max())
        if worst > 1e-6:
            raise SystemExit(f"{name} differs from the reference by {worst}")
    return ways


def size_table(maps: Maps, repetitions: int, figure: Path | None = None) -> Iterator[str]:
    yield from head_row("preset", "size", "way", "ms", "times faster than the reference")
    drawn = {}
    for preset in PRESETS:
        for size in SIZES:
            slow = 2 if preset == "paper" and size == LARGE else repetitions
            timings = time_in_turn(ways_of(maps, preset, maps.batch(size, 1)), slow, warm_up=False)
            for name, timing in timings.items():
                ratio = span(timing.times_faster_than(timings["reference"]), 1)
                yield row(preset, by(size), name, span(timing.milliseconds, 1), ratio)
        drawn[preset] = {name: timing.milliseconds for name, timing in timings.items()}
    if figure:
        draw(drawn, figure)


def draw(timings: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Milliseconds of each way at `LARGE`, by preset, on a logarithmic axis."""
    figure = Figure(figsize=(8, 2.6), layout="constrained")
    for axes, (preset, ways) in zip(figure.subplots(1, len(timings)), timings.items(), strict=True):
        medians = [of["median"] for of in ways.values()]
        ends = [[of["median"] - of["min"] for of in ways.values()]]
        ends += [[of["max"] - of["median"] for of in ways.values()]]
        bars = axes.barh(list(ways), medians, xerr=ends)
        labels = [f" {median:,.{0 if median >= 100 else 1}f}" for median in medians]
        axes.bar_label(bars, labels, padding=4)
        axes.set_xscale("log")
        axes.set_xlim(right=max(medians) * 30)
        axes.invert_yaxis()
        axes.set_xlabel("ms")
        axes.set_title(f"{preset}, {by(LARGE)}")
    save(figure, path)


def batch_table(maps: Maps, repetitions: int) -> Iterator[str]:
    yield from head_row("preset", "way", "batch", "one thread", "two threads", "speed-up")
    for preset in PRESETS:
        for (name, head), count in product(heads(maps.config(preset)).items(), (1, BATCH)):
            labels = maps.batch(LARGE, count)
            ways = {n: partial(with_threads, n, head, labels) for n in (1, 2)}
            one, two = time_in_turn(ways, 3 if preset == "paper" else repetitions).values()
            each = ({k: v / count for k, v in of.milliseconds.items()} for of in (one, two))
            ratio = span(two.times_faster_than(one), 2)
            yield row(preset, name, str(count), *(span(times, 2) for times in each), ratio)


def with_threads(count: int, head: SSRVLAD, labels: Tensor) -> Tensor:
    with threads(count):
        return head(labels)


def scene_table(maps: Maps, repetitions: int) -> Iterator[str]:
    yield from head_row("specks", "ms", "ms, uncleaned")
    paper = maps.config("paper")
    configs = [paper, replace(paper, closing=0.0, hole_area=0.0, region_area=0.0)]
    scenes = [strewn(maps.batch(LARGE, 1), count) for count in SPECKS]
    columns = []
    for config in configs:
        ways = {str(n): partial(SSRVLAD(config), scene) for n, scene in enumerate(scenes)}
        plain, *others = time_in_turn(ways, repetitions).values()
        ratios = [plain.times_faster_than(of)["median"] for of in (plain, *others)]
        times = [span(of.milliseconds, 1) for of in (plain, *others)]
        columns.append([f"{a}, {b:.1f} x plain" for a, b in zip(times, ratios, strict=True)])
    for count, *cells in zip(SPECKS, *columns, strict=True):
        yield row(str(count), *cells)
    transform = time_in_turn({"one layer": partial(correlate, LARGE)}, repetitions)["one layer"]
    yield row("any, one layer by Fourier transforms", span(transform.milliseconds, 0), "")


def correlate(shape: tuple[int, int]) -> None:
    """Counts the pairs of points of a layer at every distance and direction."""
    twice = 2 * shape[0], 2 * shape[1]
    points, context = (scipy.fft.rfft2(np.zeros(shape, np.float32), twice) for _ in range(2))
    scipy.fft.irfft2(points.conj() * context, twice)


def strewn(labels: Tensor, count: int) -> Tensor:
    rng = np.random.default_rng(count)
    scene = labels.clone()
    height, width = scene.shape[1:]
    for y, x, label in rng.integers(0, (height - 3, width - 3, 8), (count, 3)).tolist():
        scene[:, y : y + 3, x : x + 3] = label
    return scene


def memory_table(options: argparse.Namespace) -> Iterator[str]:
    yield from head_row("preset", "way", "size", "batch", "bytes a pixel")
    camvid = ["--camvid", str(options.camvid)] if options.camvid else []
    for preset, name, count in product(PRESETS, ("torch", "native core"), (1, BATCH)):
        memory = in_new_process(preset, name, *map(str, LARGE), str(count), *camvid)
        yield row(preset, name, by(LARGE), str(count), memory)


def in_new_process(*arguments: str) -> str:
    """What `print_memory` prints."""
    command = [sys.executable, __file__, "--memory", *arguments]
    env = {**os.environ, **EVERY_BUFFER_GIVEN_BACK}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=env)
    return done.stdout.strip()


def print_memory(maps: Maps, preset: str, name: str, *numbers: str) -> None:
    height, width, count = map(int, numbers)
    if name == "match":
        with threads(1):
            print(f"{peak_bytes(partial(match, *random_rows(count), 10)) / 2**20:.0f}")
        return
    head = heads(maps.config(preset))[name]
    head(maps.batch((64, 96), 2))
    labels = maps.batch((height, width), count)
    with threads(1):
        print(f"{peak_bytes(partial(head, labels)) / labels.numel():.0f}")


def peak_bytes(call: Callable[[], object]) -> int:
    """The peak of resident memory during a call minus what was resident before it. In a new
    process: what earlier calls have freed would be used again."""
    Path("/proc/self/clear_refs").write_text("5")
    before = status_bytes("VmRSS")
    call()
    return status_bytes("VmHWM") - before


def status_bytes(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(entry.split()[1]) * 1024 for entry in lines if entry.startswith(field))


def matching_section(references: int) -> Iterator[str]:
    try:
        import faiss
    except ImportError:
        yield "Not measured: faiss-cpu is not installed.\n"
        return
    faiss.omp_set_num_threads(1)
    queries, database = random_rows(references)
    index = faiss.IndexFlatIP(480)
    index.add(database)
    ways = {
        "faiss.IndexFlatIP": partial(index.search, queries, 10),
        "match": partial(match, queries, database, 10),
        "the products alone, by torch": partial(products, queries, database),
    }
    extra = in_new_process("", "match", "0", "0", str(references))
    found = match(queries, database, top=10).indices.numpy()
    same = float((found == index.search(queries, 10)[1]).mean())
    timings = time_in_turn(ways, 3, warm_up=False)
    yield paragraph(
        f"1000 queries against {references} x 480 float32, exact top 10, one thread, "
        f"faiss {faiss.__version__}:"
    )
    yield from against("faiss.IndexFlatIP", timings)
    yield paragraph(
        f"Equal candidates: {same:.4%}. Peak memory of `match` in addition to its arguments: "
        f"{extra} MB."
    )
    yield paragraph(
        f"Signs of features, at one alignment, against {references} x {math.prod(SHAPE)} bytes, "
        "exact top 10, one thread:"
    )
    signs = torch.from_numpy(
        np.random.default_rng(0).integers(0, 256, (references, *SHAPE), np.uint8)
    )
    asked, flat = signs[:: references // SIGN_QUERIES], faiss.IndexBinaryFlat(8 * math.prod(SHAPE))
    flat.add(signs.flatten(1).numpy())
    known = ReferenceRows(signs, ["map"] * references)

    def ours(queries: Tensor) -> Tensor:
        return known.compare(queries, False, False).whole().topk(10).indices

    for count in (1, SIGN_QUERIES):
        some = asked[:count]
        name = f"faiss.IndexBinaryFlat, {count} at once"
        ways = {
            name: partial(flat.search, some.flatten(1).numpy(), 10),
            f"signs, {count} at once": partial(ours, some),
        }
        yield from against(name, time_in_turn(ways, 5))


def against(other: str, timings: dict[str, Timing]) -> Iterator[str]:
    yield from head_row("way", "s", "relative to faiss")
    for name, timing in timings.items():
        seconds = {k: v / 1e3 for k, v in timing.milliseconds.items()}
        yield row(name, span(seconds, 3), span(timings[other].times_faster_than(timing), 2))
    yield ""


def products(queries: NDArray[np.float32], database: NDArray[np.float32]) -> None:
    """All products of queries and references, block by block."""
    for block in torch.from_numpy(database).split(1 << 10):
        torch.from_numpy(queries) @ block.T


def random_rows(references: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """1000 queries near rows of a database, and the database, all of length 1 or about that."""
    rng = np.random.default_rng(0)
    database = rng.standard_normal((references, 480), dtype=np.float32)
    database /= np.linalg.norm(database, axis=1, keepdims=True)
    queries = database[rng.integers(0, references, 1000)]
    return queries + 0.02 * rng.standard_normal(queries.shape, dtype=np.float32), database


def by(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]}"


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, default=None)
    arguments.add_argument("--networks", type=Path, default=None)
    arguments.add_argument("--output", type=Path, default=Path("docs/benchmark.md"))
    arguments.add_argument("--repetitions", type=int, default=5)
    arguments.add_argument("--references", type=int, default=200_000)
    arguments.add_argument("--only", nargs="+", help="sections of the page; without, all")
    arguments.add_argument("--here", action="store_true", help="print the first table only")
    arguments.add_argument("--memory", nargs=5, default=None, help=argparse.SUPPRESS)
    options = arguments.parse_args()
    maps = Maps(options.camvid)
    if options.memory:
        print_memory(maps, *options.memory)
        return
    cv2.setNumThreads(1)
    if options.here:
        with threads(1):
            for line in size_table(maps, options.repetitions):
                print(line, flush=True)
        return
    page = Page("benchmark.md", options.output, whole=not options.only)
    pictures = sorted(options.camvid.glob("0001TP/images/*.jpg")) if options.camvid else []
    figure = options.output.parent / "figures" / "benchmark.svg"
    again = options.repetitions
    small = maps.batch((360, 480), BATCH)
    parts = {
        "## One image, one thread": partial(size_table, maps, again, figure),
        "## Cost against the complexity of the scene": partial(scene_table, maps, again),
        "## Peak memory": partial(memory_table, options),
        "## From the picture to the place": partial(
            pictures_table, options.networks, pictures, again
        ),
        "## Loop closures, online": partial(loops_table),
        "## Batches and threads": partial(batch_table, maps, again),
        "## Encoding": partial(encoding_table, small, maps.config("default"), again),
        "## Matching": partial(matching_section, options.references),
    }
    if options.networks is None or not pictures:
        del parts["## From the picture to the place"]
    with threads(1):
        for heading, part in parts.items():
            name, _, kind = part.func.__name__.rpartition("_")
            if not options.only or name in options.only:
                (page.table if kind == "table" else page.section)(heading, part())
    if not options.only:
        about = f"Label maps: {maps.source}. torch {torch.__version__}, "
        about += f"Python {platform.python_version()}, {platform.machine()}."
        page.paragraph("Written by", paragraph(WRITTEN.format(about)))


WRITTEN = """Written by `scripts/pages/benchmark.py`. Cells are median [min, max]. The rows of a
table are timed in turn, and ratios are taken within one repetition. {}
[Methods](methods.md) has the costs of other methods, [scale](scale.md) those of large databases."""


if __name__ == "__main__":
    main()
