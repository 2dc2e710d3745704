"""``ssrvlad city``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..options import Seed
from ..output import progress_bar, say

FRAMES = 100
TOUR_FRAMES = 1100


def city(
    out: Annotated[Path, typer.Argument(help="Folder to write, new or empty.")],
    frames: Annotated[
        int | None,
        typer.Option(
            min=2,
            help=f"Frames of each traverse, {FRAMES} if not given; with --tour the whole tour, "
            f"about {TOUR_FRAMES}.",
        ),
    ] = None,
    seed: Seed = 0,
    tour: Annotated[
        bool,
        typer.Option(
            "--tour", help="Write one drive that comes back to its streets, for ssrvlad loops."
        ),
    ] = False,
) -> None:
    """Write the synthetic city: reference/ and query/ label PNGs (cityscapes-trainids), poses.csv
    and ground_truth.json; or with --tour the folder tour/ and poses.csv.

    Example: ssrvlad city /tmp/city --frames 200 --seed 7

    Example: ssrvlad city /tmp/tour --tour
    """
    from ...datasets.synthetic_city import write_city, write_tour

    if tour:
        with progress_bar("rendering", frames or TOUR_FRAMES) as bar:
            folder = write_tour(out, frames, seed, progress=bar.advance)
        say(f"{folder}: {len(list(folder.iterdir()))} frames")
        return
    frames = frames or FRAMES
    with progress_bar("rendering", 2 * frames) as bar:
        write_city(out, frames=frames, seed=seed, progress=bar.advance)
    say(f"{out}: {frames} reference and {frames} query frames")
