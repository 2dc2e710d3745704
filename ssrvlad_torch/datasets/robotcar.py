"""RobotCar Seasons: ``images/<condition>/<camera>/<microseconds>.jpg``.

Sattler et al., CVPR 2018. A traverse is one camera in one condition: ``dawn-rear``. The condition
``overcast-reference`` is the map; its poses are in the 3D models, ``3D-models/**/*.nvm`` (of
VisualSFM: lines ``name focal qw qx qy qz cx cy cz distortion 0``, the rotation from world to
camera). Version 2 adds poses of some query images, ``robotcar_v2_train.txt``: a name and the 4 x 4
matrix from camera to world, row by row. The world's third axis points down.
"""

from pathlib import Path

from ..files import naming
from .camera_poses import Z_DOWN, optical_axis, parse_numbers, read_poses
from .dataset import Dataset, GroundTruth, LabelsAs, Layout, Role, Traverse, folders_in, images_in
from .poses import Pose

_CAMERAS = ("left", "rear", "right")
_REFERENCE = "overcast-reference"
_V2_POSES = "robotcar_v2_train.txt"


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The data set in ``root``."""
    models = sorted((root / "3D-models").rglob("*.nvm"))
    poses = {name: pose for model in models for name, pose in read_nvm(model).items()}
    notes = [] if models else [f"{root} has no 3D-models/**/*.nvm, so {_REFERENCE} has no poses"]
    if (root / _V2_POSES).is_file():
        poses |= read_v2_poses(root / _V2_POSES)
    else:
        notes.append(f"{root} has no {_V2_POSES}, so no query has a pose")
    traverses = []
    for camera in _cameras(root):
        condition, images = camera.parent.name, images_in(camera)
        prefix, name = f"{condition}/{camera.name}/", f"{condition}-{camera.name}"
        of_camera = {key: poses[prefix + key] for key in images if prefix + key in poses}
        if images:
            role: Role = "reference" if condition == _REFERENCE else "query"
            traverses.append(Traverse.of(name, images, labels={}, poses=of_camera, role=role))
    truth = GroundTruth(metres=5.0)  # the coarse limit of Sattler et al., CVPR 2018
    notes = [f"{note}; it is at {LAYOUT.origin}" for note in notes]
    return Dataset(LAYOUT.name, root, tuple(traverses), labels_as, truth, tuple(notes))


def read_nvm(path: Path) -> dict[str, Pose]:
    """Poses by ``<condition>/<camera>/<name>``; the points of the model are not read. A file that
    is not an NVM_V3 model, ends too early, or has a line that is not a camera is a ValueError that
    names file and line."""
    poses = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        if not file.readline().startswith("NVM_V3"):
            raise ValueError(f"{path} is not an NVM_V3 model")
        lines = ((n, words) for n, line in enumerate(file, 2) if (words := line.split()))
        number, words = next(lines, (1, []))
        if not words:
            raise ValueError(f"{path} holds no number of cameras")
        with naming(f"{path} line {number}"):
            count = int(words[0])
        for missing in range(count, 0, -1):
            number, words = next(lines, (number, []))
            with naming(f"{path} line {number}"):
                if not words:
                    raise ValueError(f"the file ends {missing} cameras too early")
                numbers = parse_numbers(words[1:], 10)
                poses[_plain(words[0])] = Z_DOWN.pose(numbers[5:8], optical_axis(numbers[1:5]))
    return poses


def read_v2_poses(path: Path) -> dict[str, Pose]:
    """Poses by ``<condition>/<camera>/<name>``, from lines of a name and 16 numbers."""
    poses = read_poses(path, 16, lambda line: Z_DOWN.pose(line[3:12:4], line[2:11:4]))
    return {_plain(name): pose for name, pose in poses.items()}


def _cameras(root: Path) -> list[Path]:
    conditions = folders_in(root / "images")
    return [c for condition in conditions for c in folders_in(condition) if c.name in _CAMERAS]


def _plain(name: str) -> str:
    """A name without ``./`` and suffix: the models name PNGs, ``./<condition>/...png``."""
    return str(Path(name).with_suffix(""))


LAYOUT = Layout(
    "robotcar-seasons",
    "visuallocalization.net/datasets (RobotCar Seasons)",
    "images/<condition>/rear/*.jpg, the zips of the conditions unpacked",
    _cameras,
    read,
)
