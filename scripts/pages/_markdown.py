"""What scripts that write pages share: arguments, tables, numbers, quotes, figures."""

from __future__ import annotations

import math
import re
import subprocess
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from itertools import dropwhile, takewhile
from pathlib import Path
from textwrap import fill

from matplotlib.figure import Figure

from ssrvlad_torch.files import replacing

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


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


def span(values: dict[str, float], digits: int) -> str:
    """``1.94 [1.87, 2.30]``: median, min and max of `_timing`."""
    median, low, high = (f"{values[key]:.{digits}f}" for key in ("median", "min", "max"))
    return f"{median} [{low}, {high}]"


class Page:
    """A page of docs/. Its text is written by hand; a script fills tables and sections, and the
    commit after ``Written by `SCRIPT` ``.

    Args:
        name: in docs/.
        output: where it is written; what stands there already is filled.
        whole: whether all of it is measured now, so that the page has this commit.
    """

    def __init__(self, name: str, output: Path, whole: bool = True) -> None:
        self.output, self._whole = output, whole
        self.text = (output if output.exists() else DOCS / name).read_text(encoding="utf-8")

    def table(self, after: str, rows: Iterable[str]) -> None:
        """Replaces the first table after a text, and writes the page.

        Raises:
            ValueError: there is no such text, or no table between it and the next heading.
        """
        begin = self.text.index("\n|", self.text.index(after))
        if "\n#" in self.text[self.text.index(after) + len(after) : begin]:
            raise ValueError(f"{self.output}: expected a table after {after!r}, found a heading")
        end = re.compile(r"\n(?!\|)").search(self.text, begin + 1).start()
        self._write(begin, "\n" + "\n".join(rows), end)

    def section(self, heading: str, lines: Iterable[str]) -> None:
        """Replaces the text of a section up to the next heading, and writes the page; a new one
        comes last."""
        if f"\n{heading}\n" not in self.text:
            self.text = f"{self.text.rstrip()}\n\n{heading}\n"
        begin = self.text.index(f"\n{heading}\n") + len(heading) + 2
        end = self.text.find("\n#", begin)
        body = "\n" + "\n".join(lines).rstrip("\n") + "\n"
        self._write(begin, body, end if end >= 0 else len(self.text))

    def paragraph(self, begins: str, text: str, ends: str = "\n\n") -> None:
        """Replaces the paragraph that begins so, or its part up to an end, and writes the page.

        Raises:
            ValueError: there is no such paragraph.
        """
        begin = self.text.index(f"\n{begins}") + 1
        end = self.text.find(ends, begin)
        self._write(begin, text.rstrip("\n"), end if end >= 0 else len(self.text.rstrip("\n")))

    def _write(self, begin: int, new: str, end: int) -> None:
        self.text = self.text[:begin] + new + self.text[end:]
        script = re.compile(
            r"(Written by `scripts/pages/\w+\.py`)( of commit \w+( with changes)?)?"
        )
        if self._whole:
            self.text = script.sub(rf"\1 of commit {commit()}", self.text, count=1)
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
    """Writes text between ``<!-- mark -->`` and ``<!-- /mark -->``, and nothing else.

    Raises:
        ValueError: the file has no such marks.
    """
    before, begin, after_mark = file.read_text(encoding="utf-8").partition(f"<!-- {mark} -->")
    _, end, after = after_mark.partition(f"<!-- /{mark} -->")
    if not end:
        raise ValueError(f"{file}: expected <!-- {mark} --> and <!-- /{mark} -->, found not both")
    write(file, f"{before}{begin}{text}{end}{after}")


def first_table(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table after a heading, without its second line."""
    after = page[page.index(heading) :].splitlines()
    rows = takewhile(lambda line: line.startswith("|"), dropwhile(lambda x: x[:1] != "|", after))
    cells = [line.removeprefix("| ").removesuffix(" |").split(" | ") for line in rows]
    return [cells[0], *cells[2:]]


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
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], dpi=110, metadata=about)


def write(path: Path, page: str) -> None:
    """Writes a page and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(path)
