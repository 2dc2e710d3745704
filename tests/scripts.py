"""The scripts that write pages, as modules, and their tables."""

import importlib
from itertools import dropwhile, takewhile
from pathlib import Path
from types import ModuleType

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts" / "pages"


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A script, or one of its parts, as a module."""
    monkeypatch.syspath_prepend(SCRIPTS)
    return importlib.import_module(name)


def table(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table after a heading, without its second line."""
    lines = page[page.index(heading) :].splitlines()
    rows = dropwhile(lambda line: not line.startswith("|"), lines)
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in takewhile(lambda line: line.startswith("|"), rows)
    ]
    return [cells[0], *cells[2:]]
