"""``ssrvlad city``."""

from pathlib import Path

from ..options import Seed, argument, option, switch
from ..output import progress_bar, say

FRAMES = 100
TOUR_FRAMES = 1100


def city(
    *,
    out: Path = argument("Folder to write, new or empty."),
    frames: int | None = option(
        f"Frames of each sequence. Default: {FRAMES}, or with --tour the whole tour, about "
        f"{TOUR_FRAMES}.",
        min=2,
        max=1_000_000,
    ),
    seed: Seed = 0,
    tour: bool = switch(
        "--tour", "Write one drive that returns to its streets, for ssrvlad loops."
    ),
) -> None:
    """Write the synthetic city: label maps of cityscapes-trainids in reference/ and query/,
    poses.csv and ground_truth.json; or, with --tour, the folder tour/ and poses.csv.

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
