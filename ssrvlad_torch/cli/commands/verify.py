"""``ssrvlad verify``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ..options import Json, argument, option
from ..output import finish, note, print_json, print_table, progress_bar, say

if TYPE_CHECKING:
    from ...deployment.verify import Verification

MISMATCH = 1
"""Exit code for a file that differs from the PyTorch module."""


def verify(
    *,
    model: Path = argument("ONNX file of ssrvlad export or ssrvlad fuse."),
    labels: list[str] | None = option(
        "Label maps to compare on: a folder, glob or file; can be repeated."
    ),
    provider: str = option(
        "Execution provider of ONNX Runtime, or openvino.", default="CPUExecutionProvider"
    ),
    as_json: Json = False,
) -> None:
    """Compare an exported or fused file with the PyTorch module: on its golden pair, and on
    --labels. The verdict is exact, wrong, or cannot run; the exit code is 1 unless it is exact.

    Example: ssrvlad verify place.onnx --provider CPUExecutionProvider
    """
    from ...datasets.label_files import find_label_files
    from ...deployment.verify import verify as check
    from ...encoding.results import Skipped

    files = find_label_files(labels) if labels else []
    with progress_bar("verifying", len(files)) as bar:
        found = check(model, files, provider, bar.advance)
    for warning in found.warnings:
        note(f"{model}: {warning}")
    if as_json:
        report = {
            **dataclasses.asdict(found),
            "checks": [each._asdict() for each in found.checks],
            "skipped": [{"frame": frame, "reason": reason} for frame, reason in found.skipped],
            "by_default": found.by_default and found.by_default._asdict(),
            "difference": found.difference,
            "passed": found.passed,
        }
        print_json({"file": str(model), "provider": provider, **report})
    else:
        _print(model, found)
    if not found.passed:
        raise typer.Exit(MISMATCH)
    finish([Skipped(frame, reason) for frame, reason in found.skipped])


def _print(model: Path, found: Verification) -> None:
    from rich.table import Table

    table = Table("compared", "largest difference", "result")
    for check in (*found.checks, *filter(None, [found.by_default])):
        table.add_row(check.name, f"{check.difference:.2g}", check.problem or "equal")
    print_table(table)
    for problem in found.problems:
        say(problem)
    network = f" with {found.network}" if found.network else ""
    say(
        f"{model}: {'as expected' if found.passed else 'WRONG'}, "
        f"{found.verdict} in {found.runtime}, largest difference {found.difference:.2g}; version "
        f"{found.version}, fingerprint {found.fingerprint}, {found.labels_as}{network}"
    )
