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
    from ...evaluation.metrics import fraction
    from ..demo import STEPS, run_demo
    from ..output import print_table, progress_bar
    from ..summaries import counts

    with progress_bar("demo", STEPS * frames) as bar:
        metrics, picture = run_demo(out, frames, seed, bar.advance)
    figures = {f"RecallRate@{n}": rate for n, rate in metrics["recall_at"].items()}
    figures["AUC-PR"] = metrics["auc_pr"]
    figures["Recall@100%Precision"] = metrics["recall_at_100_precision"]
    print_table(("metric", "value"), ((name, fraction(one)) for name, one in figures.items()))
    say(counts(metrics))
    say(f"picture: {picture}")
