"""``ssrvlad poses``."""

from pathlib import Path

from ...encoding.selection import FrameSelection
from ..options import option
from ..output import note, say


def poses(
    *,
    source: FrameSelection,
    output: Path = option(
        "poses.csv to write, or new folder for pictures with @UTM@ names.",
        "--output",
        "-o",
        default=...,
    ),
) -> None:
    """Convert the poses of pictures: from KITTI, TUM, GPS, EXIF or @UTM@ names to poses.csv, or to
    pictures with the names that VPR-methods-evaluation reads.

    Example: ssrvlad poses photos/monday -o utm/database
    """
    import math

    from ...datasets.image_files import write_pictures
    from ...datasets.pose_tables import write_poses
    from ...encoding.source import open_frames

    files = open_frames(source, images=True, note=note).files
    posed = [file for file in files if not math.isnan(file.pose.x)]
    if not posed:
        raise ValueError(f"{' '.join(source.paths)}: no frame has a pose")
    if output.suffix.lower() == ".csv":
        write_poses(output, {file.frame: file.pose for file in posed})
    else:
        write_pictures(output, posed)
    say(f"{output}: {len(posed)} of {len(files)} frames have a pose")
