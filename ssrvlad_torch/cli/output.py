"""What commands print: results to stdout, notes and a progress bar to stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from ..encoding.encoder import Refusal

SOME_REFUSED = 3
"""Exit code of a command that finished with some inputs refused."""

_WIDE = 200


def note(message: str) -> None:
    """One line on stderr."""
    print(f"ssrvlad: {' '.join(message.split())}", file=sys.stderr)


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar on stderr, told of what is done; only on a terminal, so that logs stay
    clean."""
    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.advance(task, done)


def print_table(table: Table) -> None:
    """A table on stdout; where that is no terminal it is as wide as it needs to be."""
    Console(width=None if sys.stdout.isatty() else _WIDE).print(table)


def print_json(value: Mapping[str, Any]) -> None:
    """One object on one line. JSON has no NaN: a figure without a meaning is null."""
    print(json.dumps(_without_nan(value)), flush=True)


def figure(value: float) -> str:
    """A share in three digits."""
    return "-" if math.isnan(value) else f"{value:.3f}"


def interval(ends: Sequence[float]) -> str:
    """Both ends of an interval."""
    return "-" if math.isnan(ends[0]) else f"{ends[0]:.3f} to {ends[1]:.3f}"


def finish(refused: Sequence[Refusal]) -> None:
    """Ends a command that did all it could: names what was refused, and exits with code 3."""
    for refusal in refused:
        note(f"refused {refusal.frame}: {refusal.reason}")
    if refused:
        raise typer.Exit(SOME_REFUSED)


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and math.isnan(value) else value
