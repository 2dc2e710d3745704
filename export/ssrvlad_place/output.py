"""What the programs print."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ssrvlad_torch.files import one_line, printable

if TYPE_CHECKING:
    from .database import Answer


def note(line: str) -> None:
    """Prints one line on stderr."""
    print(printable(line), file=sys.stderr)


def run_program(
    name: str, run: Callable[[argparse.Namespace], int], options: argparse.Namespace
) -> int:
    """Runs a program; the exit code. An error is one line, and a reader that has enough is none."""
    try:
        code = run(options)
        print(end="", flush=True)
        return code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        file = getattr(error, "filename", None)
        note(f"{name}: {file + ': ' if file else ''}{one_line(error)}")
        return 2


def finished(skipped: int, frames: int) -> int:
    """Says how many of the frames were skipped; the exit code, 3 if there are some."""
    if not skipped:
        return 0
    note(f"skipped {skipped} of {frames} frames")
    return 3


def report(frame: str, empty: bool, answer: Answer | None, as_json: bool) -> None:
    """Prints one line about a frame; without a database there is no answer."""
    line: dict[str, Any] = {"query": frame, "candidates": [], "empty": empty}
    text = "described"
    if answer:
        ranked = [{"frame": name, "score": score} for name, score in answer.candidates]
        line |= {"candidates": ranked, "score_is": answer.score_is}
        line |= {"confidence": answer.confidence, "settled": answer.settled}
        line["poses"] = [
            {axis: None if math.isnan(value) else value for axis, value in pose.items()}
            for pose in answer.poses
        ]
        names = ", ".join(name for name, _ in answer.candidates)
        text = f"{names or 'no candidate'} (confidence {answer.confidence:.2f})"
    plain = f"{frame}: {'empty' if empty else text}"
    print(json.dumps(line) if as_json else printable(plain), flush=True)
