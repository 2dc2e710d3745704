"""``ssrvlad city``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..options import Frames, Seed


def city(
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    frames: Frames = 100,
    seed: Seed = 0,
) -> None:
    """Write the synthetic city: reference/ and query/ label PNGs (cityscapes-trainids), poses.csv
    and ground_truth.json.

    Example: ssrvlad city /tmp/city --frames 200 --seed 7
    """
    from ...datasets.synthetic_city import write_city
    from ..output import progress_bar

    with progress_bar("rendering", 2 * frames) as bar:
        write_city(out, frames=frames, seed=seed, progress=bar.advance)
    print(f"{out}: {frames} reference and {frames} query frames")
