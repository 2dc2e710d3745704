"""``ssrvlad verify``."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import typer

from ..options import Json, argument, option
from ..output import finish, print_json, print_table, progress_bar, say

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

    files = find_label_files(labels) if labels else []
    with progress_bar("verifying", len(files)) as bar:
        result = check(model, files, provider, bar.advance)
    passed = result.passed
    if as_json:
        report = {"file": str(model), "provider": provider, **dataclasses.asdict(result)}
        report["checks"] = [check._asdict() for check in result.checks]
        report |= {"verdict": result.verdict, "difference": result.difference, "passed": passed}
        print_json(report | {"skipped": [frame._asdict() for frame in result.skipped]})
    else:
        rows = ((c.name, f"{c.difference:.2g}", c.problem or "equal") for c in result.checks)
        print_table(("compared", "largest difference", "result"), rows)
        network = f" with {result.network}" if result.network else ""
        say(
            f"{model}: {'as expected' if passed else 'WRONG'}, {result.verdict} in "
            f"{result.runtime}, largest difference {result.difference:.2g}; version "
            f"{result.version}, fingerprint {result.fingerprint}, {result.labels_as}{network}"
        )
    if not passed:
        raise typer.Exit(MISMATCH)
    finish(result.skipped)


def _verify_against(model: Path, network: str, as_json: bool) -> None:
    from ...deployment.against import verify_against

    checks = verify_against(model, network)
    wrong = [_by(check.size) for check in checks if check.problem]
    if as_json:
        sizes = [check._asdict() for check in checks]
        report = {"file": str(model), "against": network, "sizes": sizes, "passed": not wrong}
        print_json(report)
    else:
        table = []
        for c in checks:
            share = "" if math.isnan(c.other_labels) else f"{c.other_labels:.2%}"
            table.append((_by(c.size), _by(c.fed), share, c.problem or "equal"))
        print_table(("picture", "fed at", "other labels", "result"), table)
        right = ", ".join(_by(check.size) for check in checks)
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


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
