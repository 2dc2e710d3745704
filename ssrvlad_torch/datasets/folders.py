"""Plain folders: one folder per sequence, as ``ssrvlad city`` writes them.

A sequence is a folder of label maps or images, or a folder with ``images/`` and ``labels/`` in it.
Without ``images/`` and ``labels/``, a JPEG is an image, and a PNG is both an image and a label map:
the command that reads it decides. Poses come from ``poses.csv``; a file with ``ground_truth`` in
its name is not a frame.
"""

from pathlib import Path

from .dataset import (
    Dataset,
    GroundTruth,
    LabelsAs,
    Layout,
    Role,
    Traverse,
    files_in,
    images_in,
    itself_or_inside,
    labels_in,
)
from .frame_file import FrameFile
from .image_files import SUFFIXES as IMAGE_SUFFIXES
from .label_files import SUFFIXES as LABEL_SUFFIXES
from .names import absolute, absolute_folder
from .pose_tables import PoseTable

_ROLES: dict[str, Role] = {
    "reference": "reference",
    "ref": "reference",
    "database": "reference",
    "query": "query",
    "queries": "query",
}
_TRUTHS = ("ground_truth.json", "ground_truth.csv", "ground_truth.npy")
_ONLY_IMAGES = tuple(suffix for suffix in IMAGE_SUFFIXES if suffix not in LABEL_SUFFIXES)


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The sequences in ``root``, or the sequence that ``root`` is."""
    file = next((root / name for name in _TRUTHS if (root / name).is_file()), None)
    traverses = []
    for folder in _sequences(root):
        name = absolute_folder(folder).name
        images, labels = _frames(folder)
        table, where = PoseTable.of_folder(folder), absolute(folder)
        poses = {
            frame: pose
            for frame, path in (labels | images).items()
            if table and (pose := table.pose_of(FrameFile(name, frame, path, folder=where)))
        }
        traverses.append(Traverse.of(name, images, labels, poses, _ROLES.get(name.lower())))
    truth = GroundTruth(file) if file else None
    return Dataset(LAYOUT.name, root, tuple(traverses), labels_as, truth)


def _sequences(root: Path) -> list[Path]:
    return itself_or_inside(root, lambda folder: any(_frames(folder)))


def _frames(folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """The images and the label maps of a sequence."""
    if (folder / "images").is_dir() or (folder / "labels").is_dir():
        return images_in(folder / "images"), labels_in(folder / "labels")
    labels = {name: path for name, path in labels_in(folder).items() if "ground_truth" not in name}
    return labels | files_in(_ONLY_IMAGES, folder), labels


LAYOUT = Layout(
    "folders",
    "",
    "folders of label maps (.png, .npy, .tif, .bmp) or images (.jpg), one per sequence",
    _sequences,
    read,
)
