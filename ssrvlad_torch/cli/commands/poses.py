"""``ssrvlad poses``."""

from __future__ import annotations

from pathlib import Path

from ..options import SourceOptions, option
from ..output import say


def poses(
    *,
    source: SourceOptions,
    output: Path = option(
        ..., "poses.csv to write; or a new folder of pictures with @UTM@ names.", "--output", "-o"
    ),
) -> None:
    """Write where pictures were taken in another form: KITTI, TUM, GPS, EXIF or @UTM@ names become
    poses.csv, or pictures get the names that VPR-methods-evaluation reads.

    Example: ssrvlad poses photos/monday -o utm/database
    """
    import math

    from ...datasets.image_files import write_pictures
    from ...datasets.poses import write_poses
    from ..sources import Source

    files = Source.open(source).image_files()
    known = [file for file in files if not math.isnan(file.pose.x)]
    if not known:
        raise ValueError(f"{' '.join(source.paths)}: no frame has a pose")
    if output.suffix.lower() == ".csv":
        write_poses(output, {file.frame: file.pose for file in known})
    else:
        write_pictures(output, known)
    say(f"{output}: {len(known)} of {len(files)} frames have a pose")
