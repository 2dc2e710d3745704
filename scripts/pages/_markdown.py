"""What scripts that write pages share: arguments, tables, numbers, quotes, figures."""

from __future__ import annotations

import csv
import math
import re
import subprocess
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from ssrvlad_torch.files import replacing

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


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


def span(values: dict[str, float], digits: int) -> str:
    """``1.94 [1.87, 2.30]``: median, min and max of `_timing`."""
    median, low, high = (f"{values[key]:.{digits}f}" for key in ("median", "min", "max"))
    return f"{median} [{low}, {high}]"


class Page:
    """A page of docs/. Its text is written by hand; a script writes its tables, each as a CSV file
    beside the page, and the commit after its own name.

    Args:
        name: in docs/.
        output: where it is written; what stands there already is filled.
        whole: whether all of it is measured now, so that the page has this commit.
    """

    def __init__(self, name: str, output: Path, whole: bool = True) -> None:
        self.output, self._whole = output, whole
        self.text = (output if output.exists() else DOCS / name).read_text(encoding="utf-8")

    def table(self, name: str, rows: Iterable[str]) -> None:
        """Writes ``NAME.csv``, and the table where the page has marks of this name."""
        lines = list(rows)
        write_csv(self.output.parent / f"{name}.csv", lines)
        if f"<!-- {name} -->" in self.text:
            self.show(name, ["", *lines, ""])

    def show(self, name: str, lines: Iterable[str]) -> None:
        """Writes lines between the marks of a name, and the page."""
        self.text = between(self.text, name, "\n".join(lines), self.output)
        if self._whole:
            script = re.escape(Path(sys.argv[0]).name)
            self.text = re.sub(
                rf"(`scripts/pages/{script}`)( of commit \w+( with changes)?)?",
                rf"\1 of commit {commit()}",
                self.text,
                count=1,
            )
        write(self.output, self.text)


@cache
def commit() -> str:
    """The short hash of the commit that is measured, and whether the sources have changes."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    changed = git("status", "--porcelain", "--", "ssrvlad_torch", "scripts", "export")
    return git("rev-parse", "--short", "HEAD") + " with changes" * bool(changed)


def quote(file: Path, mark: str, text: str) -> None:
    """Writes text between ``<!-- mark -->`` and ``<!-- /mark -->`` of a file."""
    write(file, between(file.read_text(encoding="utf-8"), mark, text, file))


def between(page: str, mark: str, text: str, file: Path) -> str:
    """The page with a text between ``<!-- mark -->`` and ``<!-- /mark -->``.

    Raises:
        ValueError: the page has no such marks.
    """
    before, begin, after_mark = page.partition(f"<!-- {mark} -->")
    _, end, after = after_mark.partition(f"<!-- /{mark} -->")
    if not end:
        raise ValueError(f"{file}: expected <!-- {mark} --> and <!-- /{mark} -->, got not both")
    return f"{before}{begin}{text}{end}{after}"


def write_csv(file: Path, lines: Iterable[str]) -> None:
    """Writes the lines of a table as CSV."""
    cells = [line.removeprefix("| ").removesuffix(" |").split(" | ") for line in lines]
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as out:
        csv.writer(out, lineterminator="\n").writerows([cells[0], *cells[2:]])


def read_csv(file: Path) -> list[dict[str, str]]:
    """The rows of a CSV file by the names of their columns."""
    with file.open(newline="", encoding="utf-8") as table:
        return list(csv.DictReader(table))


def parser(about: str, page: str, cache: str = "", needs_data: bool = True) -> ArgumentParser:
    """The arguments of a script: ``--data``, ``--cache`` where it has one, ``--output``."""
    made = ArgumentParser(description=about, formatter_class=RawDescriptionHelpFormatter)
    made.add_argument("--data", type=Path, required=needs_data, help="folder of the real drives")
    if cache:
        made.add_argument("--cache", type=Path, default=Path(".cache") / cache)
    made.add_argument("--output", type=Path, default=Path("docs") / page)
    return made


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG or SVG, without dates, and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with replacing(path) as temporary, rc_context({"svg.fonttype": "none", "svg.hashsalt": ""}):
        figure.savefig(temporary, format=path.suffix[1:], dpi=110, metadata=about)
        if path.suffix == ".svg":
            temporary.write_text(re.sub(r" +\n", "\n", temporary.read_text()))


def write(path: Path, page: str) -> None:
    """Writes a page and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(path)
