"""Parts of pages that scripts write: paragraphs, tables, numbers, the machine."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill

import torch

from ssrvlad_torch.files import replacing


def paragraph(text: str) -> str:
    """Text wrapped at 100 characters, with a newline."""
    return fill(text, 100, break_long_words=False, break_on_hyphens=False) + "\n"


def head_row(*cells: str) -> Iterator[str]:
    """The first two lines of a table."""
    yield row(*cells)
    yield row(*["---"] * len(cells))


def row(*cells: str) -> str:
    """A line of a table."""
    return f"| {' | '.join(cells)} |"


def interval(value: float, ends: Sequence[float], digits: int = 3) -> str:
    """``0.738 [0.682, 0.799]``; a dash for NaN."""
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f} [{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def largest_mean_smallest(values: Sequence[float]) -> str:
    """``max/average/min`` with three significant digits."""
    three = (max(values), sum(values) / len(values), min(values))
    return "/".join(significant(value) for value in three)


def significant(value: float, digits: int = 3) -> str:
    """A number of at least 0 with `digits` significant digits, without an exponent."""
    if value == 0:
        return "0"
    places = max(0, digits - 1 - math.floor(math.log10(value)))
    return f"{value:.{places}f}"


def processor() -> str:
    """The processor, the number of threads and the version of torch."""
    return f"one thread of a processor {_model()} ({platform.machine()}), torch {torch.__version__}"


def _model() -> str:
    """Model name of the processor, by the system if possible."""
    about = Path("/proc/cpuinfo")
    lines = about.read_text(encoding="utf-8").splitlines() if about.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def write(path: Path, page: str) -> None:
    """Writes a page and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(path)
