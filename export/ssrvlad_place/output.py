"""What the programs print."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .database import Answer


def note(line: str) -> None:
    """Prints one line on stderr."""
    print(line, file=sys.stderr)


def one_line(error: Exception) -> str:
    """The message of an error as one line, never empty."""
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"{error.filename} does not exist"
    return " ".join(str(error).split()) or type(error).__name__


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
        note(f"{name}: {one_line(error)}")
        return 2


def finished(skipped: int, described: int) -> int:
    """Says how many frames were skipped; the exit code, 3 if there are some."""
    if not skipped:
        return 0
    note(f"skipped {skipped} of {skipped + described} frames")
    return 3


def report(frame: str, empty: bool, answer: Answer | None, as_json: bool) -> None:
    """Prints one line about a frame; without a database there is no answer."""
    candidates, score_is, confidence = answer or ([], "", 0.0)
    if as_json:
        ranked = [{"frame": name, "score": score} for name, score in candidates]
        told = {"score_is": score_is, "confidence": confidence} if answer else {}
        print(json.dumps({"query": frame, "candidates": ranked, "empty": empty, **told}))
        return
    names = ", ".join(f"{name} {score:.4f}" for name, score in candidates) or "no candidate"
    found = f"{names} ({score_is}, confidence {confidence:.2f})" if answer else "described"
    print(f"{frame}: " + ("empty" if empty else found))
