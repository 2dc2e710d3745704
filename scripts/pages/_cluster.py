"""The time of `encode` with a network: the local engine against Ray on the same cores."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from _markdown import head_row, paragraph, row, span

from ssrvlad_torch.cli.bench import time_in_turn
from ssrvlad_torch.datasets.image_files import find_image_files

RUNS = 2


def cluster_section(networks: Path | None, folders: list[Path]) -> Iterator[str]:
    """The table, for the first YAML file in the folder of networks."""
    if networks is None or not folders:
        yield "Not measured: expected --networks and --pictures.\n"
        return
    settings, workers = max(networks.glob("*.yaml")), os.cpu_count() or 1
    files = find_image_files([*map(str, folders)])
    with tempfile.TemporaryDirectory() as folder:
        taken, alone = (
            time_in_turn(
                {
                    engine: partial(_encode, settings, what, Path(folder, engine), engine, workers)
                    for engine in ("local", "ray")
                },
                RUNS,
                warm_up=False,
            )
            for what in (folders, [files[0].path])
        )
    yield paragraph(
        f"`ssrvlad encode` of {len(files)} pictures with {settings.stem}: labels, features and "
        f"HOG, from the start of the command to its end, in turn {RUNS} times. Ray has {workers} "
        f"workers on the {workers} cores of this machine. Its start is part of the time."
    )
    yield from head_row("engine", "seconds", "relative to local")
    for engine, timing in taken.items():
        ratio = taken["local"].times_faster_than(timing)
        yield row(
            f"`--engine {engine}`",
            ", ".join(f"{seconds:.0f}" for seconds in timing.seconds),
            span(ratio, 2),
        )
    yield ""
    starts = [timing.milliseconds["median"] / 1e3 for timing in alone.values()]
    yield paragraph(
        f"One picture alone takes {starts[0]:.0f} and {starts[1]:.0f} s: the start, which does not "
        "grow with the pictures."
    )


def _encode(settings: Path, pictures: list[Path], target: Path, engine: str, workers: int) -> None:
    """Into a new database beside a new cache."""
    database, cache = target.with_suffix(".ssrdb"), target.with_suffix(".cache")
    for made in (database, cache):
        shutil.rmtree(made, ignore_errors=True)
    command = [sys.executable, "-m", "ssrvlad_torch", "encode", *map(str, pictures)]
    command += ["-o", str(database), "--labels-as", "cityscapes-trainids"]
    command += ["--segmenter", str(settings), "--segmenter-cache", str(cache), "--engine", engine]
    subprocess.run(
        [*command, *(["--workers", str(workers)] if engine == "ray" else [])],
        check=True,
        capture_output=True,
    )
