#!/usr/bin/env python3
"""Writes the tables of docs/evaluation/speed.md: the time of the method, in one run.

    .venv/bin/python scripts/pages/benchmark.py --camvid ../shared/data/camvid \
        --networks ../shared/data/networks

The rows of a table are timed in turn (`_timing.time_in_turn`) with a fixed number of threads. Label
maps are those of CamVid, enlarged to each size, or without it of the synthetic city. Needs the
extra `dev`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _loops_cost import loops_table
from _markdown import DOCS, Page, head_row, row, save, span, write_csv
from _picture_costs import pictures_table
from _sequence_cost import sequences_table
from _timing import heads, onnx_head, threads, time_in_turn
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, reference
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity

SIZES = [(512, 512), (1024, 1024)]
LARGE = (1024, 1024)
BATCH = 16


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


def by(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]}"


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, default=None)
    arguments.add_argument("--networks", type=Path, default=None)
    arguments.add_argument("--output", type=Path, default=Path("docs/evaluation/speed.md"))
    arguments.add_argument("--repetitions", type=int, default=5)
    arguments.add_argument("--only", nargs="+", help="tables: size, sequences, loops, pictures")
    arguments.add_argument("--here", action="store_true", help="print the first table only")
    options = arguments.parse_args()
    maps = Maps(options.camvid)
    if options.here:
        with threads(1):
            for line in size_table(maps, options.repetitions):
                print(line, flush=True)
        return
    page = Page("evaluation/speed.md", options.output, whole=not options.only)
    pictures = sorted(options.camvid.glob("0001TP/images/*.jpg")) if options.camvid else []
    again = options.repetitions
    tables = {
        "size": partial(size_table, maps, again, DOCS / "figures" / "speed.svg"),
        "sequences": partial(sequences_table, again),
        "loops": partial(loops_table),
    }
    if options.networks is not None and pictures:
        tables["pictures"] = partial(pictures_table, options.networks, pictures, again)
    with threads(1):
        for name, table in tables.items():
            if not options.only or name in options.only:
                lines = list(table())
                write_csv(page.output.parent / f"speed-{name}.csv", lines)
                page.show(f"speed-{name}", ["", *(x for x in lines if by(SIZES[0]) not in x), ""])


if __name__ == "__main__":
    main()
