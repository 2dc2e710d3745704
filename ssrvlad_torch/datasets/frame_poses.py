"""The poses of frames: from the source that the user names, or from what lies beside the frames."""

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from ..files import check_regular, naming
from .frame_file import FrameFile, RemoteFile
from .pose_tables import PoseTable, read_table
from .poses import UNKNOWN, Fix, Pose, Projection, read_exif, read_name, zone_of_name
from .trajectories import read_trajectory


def with_poses_of(
    source: str, sequences: Sequence[list[FrameFile]], projection: Projection
) -> list[list[FrameFile]]:
    """The files of each sequence with their poses in a file that has them by frame, see
    `read_table`, or by time, see `read_trajectory`, or with ``exif`` in their EXIF tags. A source
    that gives no pose is a ValueError."""
    path = Path(source)
    if source == "exif":
        poses = [_poses_of_exif(files, projection) for files in sequences]
    elif not path.is_file():
        raise ValueError(f"{source} is no file; expected a file of poses, or exif")
    elif (rows := read_table(path, projection)) is not None:
        table = PoseTable(path, rows)
        poses = [[table.pose_of(file) or UNKNOWN for file in files] for files in sequences]
        if all(pose is UNKNOWN for of_sequence in poses for pose in of_sequence):
            files = [file for of_sequence in sequences for file in of_sequence]
            raise ValueError(table.misfit(files, len(files)))
    elif len(sequences) > 1:
        raise ValueError(f"{source} holds the poses of one sequence, got {len(sequences)}")
    else:
        trajectory = read_trajectory(path, projection)
        names, stamps = zip(*((file.name, file.stamp) for file in sequences[0]), strict=True)
        with naming(source):
            poses = [trajectory.of_frames(names, stamps)]
    return [
        [
            replace(file, pose=pose, has_pose_source=True)
            for file, pose in zip(files, of_files, strict=True)
        ]
        for files, of_files in zip(sequences, poses, strict=True)
    ]


def _poses_of_exif(files: Sequence[FrameFile], projection: Projection) -> list[Pose]:
    fixes = list(map(_fix_of, files))
    if not any(fix.is_known for fix in fixes):
        raise ValueError(f"no image of {files[0].sequence} has a position in its EXIF tags")
    return projection.poses(fixes)


def _fix_of(file: FrameFile) -> Fix:
    nowhere = Fix(math.nan, math.nan)
    try:
        if isinstance(file, RemoteFile):
            return read_exif(io.BytesIO(file.read())) or nowhere
        check_regular(file.path)  # to open a pipe can block for ever
        return read_exif(file.path) or nowhere
    except (ValueError, OSError):
        return nowhere


def with_poses_beside(
    files: Sequence[FrameFile], projection: Projection, note: Callable[[str], object]
) -> list[FrameFile]:
    """The files with the poses of tables beside them or of their names, see `with_pose`; a table
    with fewer than half of the frames of a folder is noted."""
    find = cache(lambda folder: PoseTable.of_folder(folder, projection))
    posed = [with_pose(file, find) for file in files]
    zones = {zone_of_name(file.name) for file in files} - {""}
    if len(zones) > 1:
        note(f"names of files have positions of UTM zones {', '.join(sorted(zones))}; expected one")
    folders = dict[Path, list[FrameFile]]()
    for file in posed:
        folders.setdefault(file.path.parent, []).append(file)
    for folder, neighbours in folders.items():
        table = None if isinstance(neighbours[0], RemoteFile) else find(folder)
        without = [f for f in neighbours if table and math.isnan(f.pose.x) and not table.pose_of(f)]
        if table and 2 * len(without) > len(neighbours):
            note(table.misfit(without, len(neighbours)))
    return posed


def with_pose(file: FrameFile, find: Callable[[Path], PoseTable | None]) -> FrameFile:
    """A file with the pose of the table that ``find`` gives for its folder, or of its name, see
    `read_name`; a ValueError if a table is damaged, or can mean two frames."""
    if isinstance(file, RemoteFile):
        return file
    pose, stamp = read_name(file.name)
    table = find(file.path.parent)
    pose = (table and table.pose_of(file)) or pose
    stamp = stamp if math.isnan(file.stamp) else file.stamp
    has_source = bool(table) or not math.isnan(pose.x)
    return replace(file, pose=pose, stamp=stamp, has_pose_source=has_source)
