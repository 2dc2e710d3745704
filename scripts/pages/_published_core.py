"""The core that wheels hold, by the compiler of ziglang, beside a build by this machine's."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from _markdown import head_row, row, span

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from hatch_build import FOLDER, SHARED, WHEELS, ZIG, compile_core, compiler  # noqa: E402

COMPILERS = {
    "local": [*compiler(), *SHARED],
    "wheel": [*ZIG, "-target", WHEELS["linux_x86_64"].target, *SHARED],
}


class Cores:
    """Both libraries, in a folder."""

    def __init__(self, folder: Path) -> None:
        for name, command in COMPILERS.items():
            (folder / name).mkdir()
            if problem := compile_core(ROOT / FOLDER, command, folder / name / "libssrvlad.so"):
                raise RuntimeError(problem)
        self._folder = folder

    def output(self, name: str, *arguments: str) -> str:
        """What ``tests/bits.cpp`` prints with a library."""
        folder = self._folder / name
        if not (folder / "bits").exists():
            flags = ["-std=c++17", "-O1", f"-I{ROOT / FOLDER}", f"-Wl,-rpath,{folder}"]
            sources = [ROOT / "tests" / "bits.cpp", folder / "libssrvlad.so"]
            subprocess.run([*compiler(), *flags, *sources, "-o", folder / "bits"], check=True)
        return subprocess.check_output([folder / "bits", *arguments], text=True)

    def seconds(self, repetitions: int) -> dict[str, list[float]]:
        """Processor time of a query with each, measured in turn."""
        times: dict[str, list[float]] = {name: [] for name in COMPILERS}
        for _ in range(repetitions):
            for name, each in times.items():
                each.append(float(self.output(name, "time")))
        return times


def summary(values: list[float]) -> dict[str, float]:
    """As of `_timing`."""
    return {"median": median(values), "min": min(values), "max": max(values)}


def published_table(repetitions: int) -> Iterator[str]:
    """The rows of the page."""
    with tempfile.TemporaryDirectory() as folder:
        times = Cores(Path(folder)).seconds(repetitions)
    yield from head_row("core", "s", "relative to local")
    for name, each in times.items():
        ratios = [one / local for one, local in zip(each, times["local"], strict=True)]
        yield row(name, span(summary(each), 3), span(summary(ratios), 2))
