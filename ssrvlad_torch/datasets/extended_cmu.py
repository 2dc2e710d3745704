"""Extended CMU Seasons: ``slice7/{database,query}/img_00119_c0_1287503873253450us.jpg``.

Sattler et al., CVPR 2018. A slice is a stretch of road, driven on twelve days by a car with two
cameras, ``c0`` and ``c1``; the name of an image ends in its time in microseconds since 1970. A
traverse is one camera on one day (UTC): ``slice7-c0-2010-10-01``. Poses are lines
``name qw qx qy qz cx cy cz``, the rotation from world to camera and the camera's centre, in a world
whose z points up: for the reference traverse in ``ground-truth-database-images-slice7.txt``,
for about half of the query images in ``camera-poses/*.txt``.
"""

import re
from datetime import UTC, datetime
from itertools import product
from pathlib import Path

from .camera_poses import Z_UP, optical_axis, read_poses
from .dataset import (
    Dataset,
    GroundTruth,
    LabelsAs,
    Layout,
    Role,
    Traverse,
    images_in,
    itself_or_inside,
)
from .names import absolute_folder
from .poses import Pose

_SLICE = re.compile(r"slice\d+")
_NAME = re.compile(r"img_\d+_(c\d)_(\d{16})us(?:_rect)?")
_POSES = "ground-truth-database-images-slice*.txt"
_ROLES: dict[str, Role] = {"database": "reference", "query": "query"}


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The slices in ``root``, or the slice that ``root`` is."""
    traverses, notes = list[Traverse](), list[str]()
    for folder, (half, role) in product(_slices(root), _ROLES.items()):
        images = images_in(folder / half)
        pattern = _POSES if half == "database" else "camera-poses/*.txt"
        lists = [read_list(file) for file in sorted(folder.glob(pattern))]
        known = {name: pose for poses in lists for name, pose in poses.items()}
        if images and not known:
            notes.append(f"{folder / half} has no poses; they are at {LAYOUT.origin}")
        poses = {name: known[_plain(name)] for name in images if _plain(name) in known}
        drives: dict[str, dict[str, Path]] = {}
        unknown = []
        for name, path in images.items():
            if parts := _NAME.fullmatch(name):
                day = datetime.fromtimestamp(int(parts[2]) / 1e6, UTC).date()
                drive = f"{absolute_folder(folder).name}-{parts[1]}-{day}"
                drives.setdefault(drive, {})[name] = path
            else:
                unknown.append(path.name)
        if unknown:
            notes.append(
                f"{len(unknown)} images in {folder / half} are left out, for example "
                f"{unknown[0]!r}: expected names img_<number>_c<camera>_<microseconds>us"
            )
        traverses += [
            Traverse.of(drive, files, labels={}, poses=poses, role=role)
            for drive, files in sorted(drives.items())
        ]
    truth = GroundTruth(metres=5.0)  # Nie et al., arXiv 2202.03677
    return Dataset(LAYOUT.name, root, tuple(traverses), labels_as, truth, tuple(notes))


def read_list(path: Path) -> dict[str, Pose]:
    """Poses by image name without suffix, from lines ``name qw qx qy qz cx cy cz``."""
    poses = read_poses(path, 7, lambda line: Z_UP.pose(line[4:], optical_axis(line[:4])))
    return {_plain(Path(name).stem): pose for name, pose in poses.items()}


def _slices(root: Path) -> list[Path]:
    def is_slice(folder: Path) -> bool:
        named = _SLICE.fullmatch(absolute_folder(folder).name)
        return named is not None and any((folder / half).is_dir() for half in _ROLES)

    return itself_or_inside(root, is_slice)


def _plain(name: str) -> str:
    """The name of an image in the lists of poses: without the ``_rect`` of an undistorted copy."""
    return name.removesuffix("_rect")


LAYOUT = Layout(
    "extended-cmu",
    "visuallocalization.net/datasets (Extended CMU Seasons, slice*.tar)",
    "slice*/database/*.jpg and slice*/query/*.jpg",
    _slices,
    read,
)
