"""Output of commands: results on stdout, notes and a progress bar on stderr. What others print, as
a network while it is loaded, or a program that it starts, goes to stderr too."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

import typer

from ..files import printable

if TYPE_CHECKING:
    import rich.progress

    from ..encoding.results import Skipped

SOME_SKIPPED, ALL_SKIPPED = 3, 2
"""Exit codes of a command that finished with some inputs skipped, and where none was usable."""

_WIDE = 200
_NAMED = 20
"""Largest number of frames of a kind, as skipped ones, that are named."""

_SECONDS, _LINE_SECONDS = 0.2, 15.0
"""Time between two updates of a progress bar, which come in batches, and between two lines of
progress where there is no terminal."""


_RESULTS: ContextVar[TextIO] = ContextVar("results")
"""Where results go while a command runs, in place of ``sys.stdout``."""


@contextmanager
def results_alone() -> Iterator[None]:
    """While it lasts, only this module prints on stdout, also by its file descriptor: that is then
    stderr, and results go to a copy of it."""
    results = _RESULTS.get(sys.stdout)
    try:
        is_stdout = results.fileno() == 1
    except (AttributeError, OSError):  # none, or a stream in memory
        is_stdout = False
    with ExitStack() as stack:
        if is_stdout:
            results.flush()
            encoding, errors = results.encoding, results.errors
            copy = os.fdopen(os.dup(1), "w", encoding=encoding, errors=errors)
            results = stack.enter_context(copy)
            os.dup2(2, 1)
            stack.callback(os.dup2, results.fileno(), 1)
        stack.callback(_RESULTS.reset, _RESULTS.set(results))
        stack.enter_context(redirect_stdout(sys.stderr))
        yield


def note(message: str) -> None:
    """Prints one line on stderr."""
    say(f"ssrvlad: {' '.join(message.split())}", sys.stderr)


def say(text: object, file: TextIO | None = None) -> None:
    """Prints one line, by default on stdout. Unprintable characters, such as a newline in the name
    of a file, are escaped."""
    print(printable(text), file=file or _RESULTS.get(sys.stdout), flush=True)


class Bar:
    """A progress bar on stderr, see `progress_bar`."""

    def __init__(self, bar: rich.progress.Progress, what: str, total: int, then: str) -> None:
        self._what, self._total, self._bar, self._then = what, total, bar, then
        self._task = bar.add_task(what, total=total, rate="")
        self._done = self._skipped = 0
        self._start = self._shown = time.monotonic()
        self._pause = 0.0 if bar.console.is_terminal else _LINE_SECONDS  # the first update at once

    def advance(self, steps: int) -> None:
        """So many more steps are done."""
        self._done += steps
        if time.monotonic() > self._shown + self._pause:
            self.show()
        if self._done == self._total and self._then:
            self._bar.update(self._task, description=self._then)

    def skip(self, _frame: object) -> None:
        """A frame was skipped."""
        self._skipped += 1

    def show(self) -> None:
        """Shows what was done."""
        self._shown = time.monotonic()
        also = f", {self._skipped} skipped" if self._skipped else ""
        if self._bar.console.is_terminal:
            self._pause = _SECONDS
            rate = self._bar.tasks[self._task].speed
            text = (f"{rate:.0f}/s" if rate else "") + also
            self._bar.update(self._task, completed=self._done, rate=text)
        else:
            after = self._shown - self._start
            note(f"{self._what}: {self._done} of {self._total} after {after:.0f} s{also}")


@contextmanager
def progress_bar(what: str, total: int, then: str = "") -> Iterator[Bar]:
    """Shows a progress bar on stderr, with the rate and, if any are skipped, their number; with
    ``then``, what follows the last step. Where stderr is no terminal, a line appears every
    `_LINE_SECONDS`."""
    from rich import progress
    from rich.console import Console

    columns = (
        progress.TextColumn("{task.description}", markup=False),
        *(progress.BarColumn(), progress.MofNCompleteColumn()),
        progress.TextColumn("{task.fields[rate]}", markup=False),
        *(progress.TimeElapsedColumn(), progress.TimeRemainingColumn()),
    )
    console = Console(stderr=True)
    with progress.Progress(*columns, console=console, disable=not console.is_terminal) as drawn:
        bar = Bar(drawn, what, total, then)
        try:
            yield bar
        finally:
            if console.is_terminal:
                bar.show()


def print_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Prints a table on stdout, in full width if stdout is no terminal."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    def cell(value: object) -> Text:  # a str could hold markup
        return Text("\n".join(map(printable, str(value).split("\n"))))

    table = Table()
    for name in head:
        table.add_column(cell(name))
    for row in rows:
        table.add_row(*map(cell, row))
    results = _RESULTS.get(sys.stdout)
    console = Console(file=results, width=None if results.isatty() else _WIDE)
    with console.capture() as captured:
        console.print(table)
    print(captured.get(), end="", file=results)


def print_json(value: Mapping[str, Any]) -> None:
    """Prints one object on one line. A number that is not finite, such as a metric without a value,
    becomes null."""
    finite = json.loads(json.dumps(value), parse_constant=lambda _: None)
    print(json.dumps(finite), file=_RESULTS.get(sys.stdout), flush=True)


def weights_in_words(weights: Sequence[Mapping[str, float]]) -> list[str]:
    """The weights of fused methods in each sequence; an empty list for a single method."""
    if not any(weights):
        return []
    names = (f"{name} {'/'.join(f'{of[name]:.2f}' for of in weights)}" for name in weights[0])
    return [f"fused: {' + '.join(names)}"]


def note_skipped(frame: Skipped) -> None:
    """Names a skipped frame."""
    note(f"skipped {frame.frame}: {frame.reason}")


def note_first(frames: Sequence[Any], note_one: Callable[[Any], object], others: str) -> None:
    """Notes the first of many frames one by one, and after ``others`` how many more there are."""
    for frame in frames[:_NAMED]:
        note_one(frame)
    if len(frames) > _NAMED:
        note(f"{others} {len(frames) - _NAMED} more")


def finish(
    skipped: Sequence[Skipped], described: int | None = None, are_named: bool = False
) -> None:
    """Ends a command. If inputs were skipped, names them, unless they are named already, and exits
    with code 3, or 2 if no frame could be described. ``described`` is the number of frames that the
    command described, ``None`` if it describes none; if it is 0 and the label space is the reason,
    a note asks for ``--labels-as``."""
    if skipped and described == 0 and all("label space" in frame.reason for frame in skipped):
        note("no frame could be described: is --labels-as the label space of these label maps?")
    note_first(() if are_named else skipped, note_skipped, "skipped")
    if skipped:
        raise typer.Exit(ALL_SKIPPED if described == 0 else SOME_SKIPPED)
