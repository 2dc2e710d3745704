"""Interrupts at any line of some modules, as Ctrl-C between two lines; shared by tests."""

import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1] / "ssrvlad_torch"


class Lines:
    """Runs a call, and interrupts it at a line of some files of the package.

    Args:
        files: below the package, or folders.
        at: number of the line at which a KeyboardInterrupt is raised, of those that are reached for
            the first time; without, none is raised.

    Attributes:
        count: of the lines that were reached.
    """

    def __init__(self, files: Collection[str], at: int | None = None) -> None:
        self._files, self._at = tuple(str(PACKAGE / file) for file in files), at
        self._lines = set[tuple[str, int]]()

    @property
    def count(self) -> int:
        return len(self._lines)

    def _enter(self, frame: Any, event: str, _: object) -> Any:
        return self._line if frame.f_code.co_filename.startswith(self._files) else None

    def _line(self, frame: Any, event: str, _: object) -> Any:
        line = frame.f_code.co_filename, frame.f_lineno
        if event == "line" and line not in self._lines:
            self._lines.add(line)
            if self.count == self._at:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._line

    def run(self, call: Callable[[], object]) -> bool:
        """Runs a call; whether it was interrupted."""
        before = sys.gettrace()
        sys.settrace(self._enter)
        try:
            call()
        except KeyboardInterrupt:
            return True
        finally:
            sys.settrace(before)
        return False
