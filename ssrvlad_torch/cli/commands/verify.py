"""``ssrvlad verify``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..options import Json, argument, option
from ..output import finish, note, print_json, print_table, progress_bar, say

if TYPE_CHECKING:
    from ...deployment.verify import Verification

MISMATCH = 1
"""Exit code of a file that does not give what it should."""


def verify(
    *,
    model: Path = argument("ONNX file of export or fuse."),
    labels: list[str] | None = option(
        None, "Label maps to compare on: a folder, glob or file; repeatable."
    ),
    provider: str = option(
        "CPUExecutionProvider", "Execution provider of ONNX Runtime, or openvino."
    ),
    as_json: Json = False,
) -> None:
    """Compare an exported or fused file on a runtime with the PyTorch module: on its golden pair,
    a corpus of drawn maps, and label maps. Where they differ the exit code is 1, and the stage of
    the graph that differs first is named, or the node that cannot be run.

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
        print_json({"file": str(model), "provider": provider, **_as_json(found)})
    else:
        _print(model, found)
    if not found.passed:
        raise typer.Exit(MISMATCH)
    finish([Skipped(frame, reason) for frame, reason in found.skipped])


def _as_json(found: Verification) -> dict[str, Any]:
    return {
        **dataclasses.asdict(found),
        "checks": [one._asdict() for one in found.checks],
        "skipped": [{"frame": frame, "reason": reason} for frame, reason in found.skipped],
        "fault": found.fault and found.fault._asdict(),
        "difference": found.difference,
        "verdict": found.verdict,
        "passed": found.passed,
    }


def _print(model: Path, found: Verification) -> None:
    from rich.table import Table

    table = Table("compared", "largest difference", "result")
    for one in found.checks:
        table.add_row(one.name, f"{one.difference:.2g}", one.problem or "equal")
    print_table(table)
    for problem in found.problems:
        say(problem)
    if found.fault:
        say(f"{found.fault.kind}, {found.fault.place}: {found.fault.reason}")
    network = f" with {found.network}" if found.network else ""
    say(
        f"{model}: {'as it should be' if found.passed else 'NOT as it should be'}, "
        f"{found.verdict} in {found.runtime}, largest difference {found.difference:.2g}; version "
        f"{found.version}, fingerprint {found.fingerprint}, {found.labels_as}{network}"
    )
