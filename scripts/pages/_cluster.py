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
from ssrvlad_torch.database.database import Database

RUNS = 2


def cluster_section(networks: Path | None, folders: list[Path]) -> Iterator[str]:
    """The table, for the first YAML file in the folder of networks."""
    if networks is None or not folders:
        yield "Not measured: expected --networks and --pictures.\n"
        return
    settings, workers = max(networks.glob("*.yaml")), os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        ways = {
            engine: partial(_encode, settings, folders, Path(folder, engine), engine, workers)
            for engine in ("local", "ray")
        }
        taken = time_in_turn(ways, RUNS, warm_up=False)
        frames = len(Database.open(f"{folder}/ray.ssrdb").load().frames)
    yield paragraph(
        f"`ssrvlad encode` of {frames} pictures with {settings.stem}: labels, features and HOG, "
        f"from the start of the command to its end, in turn {RUNS} times. Ray has {workers} "
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


def _encode(settings: Path, folders: list[Path], target: Path, engine: str, workers: int) -> None:
    """Into a new database beside a new cache."""
    database, cache = target.with_suffix(".ssrdb"), target.with_suffix(".cache")
    for made in (database, cache):
        shutil.rmtree(made, ignore_errors=True)
    command = [sys.executable, "-m", "ssrvlad_torch", "encode", *map(str, folders)]
    command += ["-o", str(database), "--labels-as", "cityscapes-trainids"]
    command += ["--segmenter", str(settings), "--segmenter-cache", str(cache), "--engine", engine]
    subprocess.run(
        [*command, *(["--workers", str(workers)] if engine == "ray" else [])],
        check=True,
        capture_output=True,
    )
