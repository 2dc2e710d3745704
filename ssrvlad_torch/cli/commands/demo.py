"""``ssrvlad demo``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..options import Frames, Seed, option
from ..output import say


def demo(
    *,
    out: Path = option(Path("ssrvlad-demo"), "Folder for all that it writes."),
    frames: Frames = 100,
    seed: Seed = 0,
) -> None:
    """The main job on generated data: drive twice through a synthetic city, encode, match,
    evaluate, picture.

    Example: ssrvlad demo --out /tmp/ssrvlad-demo
    """
    from ..demo import STEPS, run_demo
    from ..output import progress_bar

    with progress_bar("demo", STEPS * frames) as bar:
        result = run_demo(out, frames, seed, bar.advance)
    _print_metrics(result.metrics)
    say(f"picture: {result.picture}")


def _print_metrics(metrics: Mapping[str, Any]) -> None:
    from rich.table import Table

    from ..measure import counts
    from ..output import figure, print_table

    table = Table("metric", "value")
    for n, rate in metrics["recall_at"].items():
        table.add_row(f"RecallRate@{n}", figure(rate))
    table.add_row("AUC-PR", figure(metrics["auc_pr"]))
    table.add_row("Recall@100%Precision", figure(metrics["recall_at_100_precision"]))
    print_table(table)
    say(counts(metrics))
