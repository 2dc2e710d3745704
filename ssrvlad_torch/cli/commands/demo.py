"""``ssrvlad demo``."""

from pathlib import Path

from ..options import Seed, option
from ..output import say


def demo(
    *,
    out: Path = option("Folder to write, new or empty.", default=Path("ssrvlad-demo")),
    frames: int = option("Frames of each sequence.", default=100, min=2),
    seed: Seed = 0,
) -> None:
    """Run the method on generated data: two drives through a synthetic city are encoded, matched
    and evaluated, and a picture shows some matches.

    Example: ssrvlad demo --out /tmp/ssrvlad-demo
    """
    from rich.table import Table

    from ...evaluation.metrics import fraction
    from ..demo import STEPS, run_demo
    from ..output import print_table, progress_bar
    from ..words import counts

    with progress_bar("demo", STEPS * frames) as bar:
        metrics, picture = run_demo(out, frames, seed, bar.advance)
    table = Table("metric", "value")
    for n, rate in metrics["recall_at"].items():
        table.add_row(f"RecallRate@{n}", fraction(rate))
    table.add_row("AUC-PR", fraction(metrics["auc_pr"]))
    table.add_row("Recall@100%Precision", fraction(metrics["recall_at_100_precision"]))
    print_table(table)
    say(counts(metrics))
    say(f"picture: {picture}")
