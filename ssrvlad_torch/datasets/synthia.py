"""SYNTHIA video sequences: ``SYNTHIA-SEQS-04-FALL/GT/LABELS/Stereo_Left/Omni_F/000000.png``.

Ros et al., CVPR 2016. A traverse is one camera in one season:
``SYNTHIA-SEQS-04-FALL-Stereo_Left-Omni_F``. Label maps are PNGs of 16-bit channels, the class in
the first, the instance in the second. ``CameraParams`` has one file per frame: the 16 numbers of
the matrix from camera to world, column by column. The world comes from Unity: it is left-handed
with y up, and a camera looks along its own -z. The ground plane is x and z, as in VPR-Bench.
"""

from pathlib import Path

from ..files import naming
from .camera_poses import Y_UP_LEFT_HANDED, parse_numbers
from .dataset import (
    Dataset,
    GroundTruth,
    LabelsAs,
    Layout,
    Traverse,
    files_in,
    images_in,
    itself_or_inside,
    labels_in,
)
from .names import absolute_folder
from .poses import Pose

_LABELS, _IMAGES, _POSES = "GT/LABELS", "RGB", "CameraParams"


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The sequences in ``root``, or the sequence that ``root`` is."""
    traverses, notes = list[Traverse](), list[str]()
    for folder in _sequences(root):
        notes += [
            f"{folder} has no {kind}; it is in the package at {LAYOUT.origin}"
            for kind in (_LABELS, _POSES)
            if not (folder / kind).is_dir()
        ]
        for camera in _cameras(folder):
            images = images_in(folder / _IMAGES / camera)
            labels = labels_in(folder / _LABELS / camera)
            poses = {
                name: read_pose(file)
                for name, file in files_in((".txt",), folder / _POSES / camera).items()
                if name in images or name in labels
            }
            name = f"{absolute_folder(folder).name}-{'-'.join(camera.parts)}"
            if images or labels:
                traverses.append(Traverse.of(name, images, labels, poses))
    truth = GroundTruth(metres=7.0)  # on x and z, as in VPR-Bench
    return Dataset(LAYOUT.name, root, tuple(traverses), labels_as or "synthia", truth, tuple(notes))


def read_pose(path: Path) -> Pose:
    """The pose of one frame. A file without 16 numbers is a ValueError that names it."""
    with naming(path):
        matrix = parse_numbers(path.read_text(encoding="utf-8", errors="replace").split(), 16)
    return Y_UP_LEFT_HANDED.pose(matrix[12:15], [-number for number in matrix[8:11]])


def _sequences(root: Path) -> list[Path]:
    return itself_or_inside(root, _cameras)


def _cameras(folder: Path) -> list[Path]:
    """The folders of cameras on disk, ``Stereo_Left/Omni_F`` and so on."""
    cameras = {
        camera.relative_to(folder / kind)
        for kind in (_LABELS, _IMAGES)
        for camera in (folder / kind).glob("Stereo_*/Omni_*")
    }
    return sorted(cameras)


LAYOUT = Layout(
    "synthia",
    "synthia-dataset.net (SYNTHIA-SEQS-<number>-<season>)",
    "SYNTHIA-SEQS-*/GT/LABELS/Stereo_Left/Omni_F/*.png",
    _sequences,
    read,
)
