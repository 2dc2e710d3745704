"""``ssrvlad verify``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..options import Json, argument, option
from ..output import finish, note, print_json, print_table, progress_bar, say

if TYPE_CHECKING:
    from ...deployment.against import SizeCheck
    from ...deployment.verify import Verification

MISMATCH = 1
"""Exit code for a file that differs from the PyTorch module."""

_CPU = "CPUExecutionProvider"


def verify(
    *,
    model: Path = argument(
        "ONNX file of ssrvlad export or ssrvlad fuse; with --against also a network's own, or a "
        ".yaml file that names one."
    ),
    against: str | None = option(
        "Compare with this network in PyTorch, of which the file was made: MODULE:NAME, a .yaml "
        "file with its settings, or another name of a network. Pictures of three sizes must get "
        "the same labels: an export can be right only at the size at which it was traced."
    ),
    labels: list[str] | None = option(
        "Label maps to compare on: a folder, glob or file; can be repeated."
    ),
    provider: str = option("Execution provider of ONNX Runtime, or openvino.", default=_CPU),
    as_json: Json = False,
) -> None:
    """Compare an exported or fused file with the PyTorch module: on its golden pair, and on
    --labels. The verdict is exact, wrong, or cannot run; the exit code is 1 unless it is exact.
    With --against, compare a network's ONNX file with the network in PyTorch.

    Example: ssrvlad verify place.onnx --provider CPUExecutionProvider
    """
    if against is not None:
        if labels or provider != _CPU:
            raise ValueError("--labels and --provider do not go with --against")
        _verify_against(model, against, as_json)
        return
    from ...datasets.label_files import find_label_files
    from ...deployment.verify import verify as check
    from ...encoding.results import Skipped

    files = find_label_files(labels) if labels else []
    with progress_bar("verifying", len(files)) as bar:
        result = check(model, files, provider, bar.advance)
    for warning in result.warnings:
        note(f"{model}: {warning}")
    if as_json:
        print_json({"file": str(model), "provider": provider, **_as_json(result)})
    else:
        _print(model, result)
    if not result.passed:
        raise typer.Exit(MISMATCH)
    finish([Skipped(frame, reason) for frame, reason in result.skipped])


def _as_json(result: Verification) -> dict[str, Any]:
    return {
        **dataclasses.asdict(result),
        "checks": [check._asdict() for check in result.checks],
        "skipped": [{"frame": frame, "reason": reason} for frame, reason in result.skipped],
        "by_default": result.by_default and result.by_default._asdict(),
        "difference": result.difference,
        "passed": result.passed,
    }


def _print(model: Path, result: Verification) -> None:
    from rich.table import Table

    table = Table("compared", "largest difference", "result")
    for check in (*result.checks, *filter(None, [result.by_default])):
        table.add_row(check.name, f"{check.difference:.2g}", check.problem or "equal")
    print_table(table)
    for problem in result.problems:
        say(problem)
    network = f" with {result.network}" if result.network else ""
    say(
        f"{model}: {'as expected' if result.passed else 'WRONG'}, "
        f"{result.verdict} in {result.runtime}, largest difference {result.difference:.2g}; "
        f"version {result.version}, fingerprint {result.fingerprint}, {result.labels_as}{network}"
    )


def _verify_against(model: Path, network: str, as_json: bool) -> None:
    from ...deployment.against import SIZES, verify_against

    with progress_bar("verifying", len(SIZES)) as bar:
        checks = verify_against(model, network, bar.advance)
    wrong = [_by(check.size) for check in checks if check.problem and check.compared]
    if as_json:
        sizes = [check._asdict() for check in checks]
        report = {"file": str(model), "against": network, "sizes": sizes, "passed": not wrong}
        print_json(report)
    else:
        _print_sizes(checks)
        right = ", ".join(_by(check.size) for check in checks if check.compared)
        verdict = f"as expected, gives the labels of {network} at {right}"
        if wrong:
            verdict = f"WRONG, gives other labels than {network} at {', '.join(wrong)}: {_CAUSES}"
        say(f"{model}: {verdict}")
    if wrong:
        raise typer.Exit(MISMATCH)


_CAUSES = (
    "it was traced at another size, which the network uses in Python, or has other weights, or "
    "another preparation of pictures. Export it for one size, or compute with sizes in tensors"
)


def _print_sizes(checks: list[SizeCheck]) -> None:
    from rich.table import Table

    table = Table("picture", "fed at", "other labels", "result")
    for check in checks:
        others = f"{check.others:.2%}" if check.others == check.others else ""
        table.add_row(_by(check.size), _by(check.fed), others, check.problem or "equal")
    print_table(table)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
