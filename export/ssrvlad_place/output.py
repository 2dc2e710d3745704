"""What the programs print."""

from __future__ import annotations

import json
import sys

SOME_SKIPPED = 3
"""The exit code if some frames were skipped."""


def note(line: str) -> None:
    """Prints one line on stderr."""
    print(line, file=sys.stderr)


def one_line(error: Exception) -> str:
    """The message of an error as one line, never empty."""
    return " ".join(str(error).split()) or type(error).__name__


def report(frame: str, empty: bool, candidates: list[tuple[str, float]], as_json: bool) -> None:
    """Prints one line about a frame."""
    if as_json:
        ranked = [{"frame": name, "score": score} for name, score in candidates]
        print(json.dumps({"query": frame, "candidates": ranked, "empty": empty}))
    else:
        names = ", ".join(f"{name} {score:.4f}" for name, score in candidates)
        print(f"{frame}: " + ("empty" if empty else names or "described"))
