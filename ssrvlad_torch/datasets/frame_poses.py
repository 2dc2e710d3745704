"""The poses of frames: from the source that the user names, or from what lies beside the frames."""

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from ..files import check_regular, naming
from .frame_file import FrameFile, RemoteFile
from .pose_tables import PoseTable, read_poses
from .poses import UNKNOWN, Fix, Pose, Projection, read_exif, read_name
from .trajectories import read_trajectory


def with_poses_of(
    source: str, sequences: Sequence[list[FrameFile]], projection: Projection
) -> list[list[FrameFile]]:
    """The files of each sequence with their poses in a CSV file, see `read_poses`, in a file of
    KITTI, TUM or GPX, see `read_trajectory`, or with ``exif`` in their EXIF tags. A source that
    gives no pose is a ValueError."""
    path = Path(source)
    if source == "exif":
        poses = [_poses_of_exif(files, projection) for files in sequences]
    elif not path.is_file():
        raise ValueError(f"{source} is no file; expected a file of poses, or exif")
    elif path.suffix.lower() == ".csv":
        table = PoseTable(path, read_poses(path, projection))
        poses = [[table.pose_of(file) or UNKNOWN for file in files] for files in sequences]
        if all(pose is UNKNOWN for of_sequence in poses for pose in of_sequence):
            raise ValueError(table.misfit(sequences[0][0]))
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
    if not any(fixes):
        raise ValueError(f"no image of {files[0].sequence} has a position in its EXIF tags")
    return [projection.pose(fix) if fix else UNKNOWN for fix in fixes]


def _fix_of(file: FrameFile) -> Fix | None:
    try:
        if isinstance(file, RemoteFile):
            return read_exif(io.BytesIO(file.read()))
        check_regular(file.path)  # to open a pipe can block for ever
        return read_exif(file.path)
    except (ValueError, OSError):
        return None


def with_poses_beside(
    files: Sequence[FrameFile], projection: Projection, note: Callable[[str], object]
) -> list[FrameFile]:
    """The files with the poses of tables beside them or of their names, see `with_pose`; a table
    that fits no frame is noted."""
    find = cache(lambda folder: PoseTable.of_folder(folder, projection))
    posed = [with_pose(file, find) for file in files]
    folders = dict[Path, list[FrameFile]]()
    for file in posed:
        folders.setdefault(file.path.parent, []).append(file)
    for folder, neighbours in folders.items():
        table = None if isinstance(neighbours[0], RemoteFile) else find(folder)
        is_posed = any(not math.isnan(file.pose.x) for file in neighbours)
        if table and not is_posed and not any(map(table.pose_of, neighbours)):
            note(table.misfit(neighbours[0]))
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
