"""Plain folders: one folder per sequence, as ``ssrvlad city`` writes them.

A sequence is a folder of label maps or images, or a folder with ``images/`` and ``labels/`` in it.
Without ``images/`` and ``labels/``, a JPEG is an image, and a PNG is both an image and a label map:
the command that reads it decides. Poses come from ``poses.csv``; a file with ``ground_truth`` in
its name is not a frame.
"""

from dataclasses import dataclass
from pathlib import Path

from ..files import natural_key
from .dataset import (
    Dataset,
    DatasetFrame,
    GroundTruth,
    LabelsAs,
    Role,
    files_in,
    folders_in,
    images_in,
    labels_in,
)
from .frame_file import FrameFile
from .label_files import SUFFIXES as LABEL_SUFFIXES
from .layout import Layout
from .names import IMAGE_SUFFIXES, absolute, absolute_folder
from .pose_tables import PoseTable
from .poses import UNKNOWN

_ROLES: dict[str, Role] = {
    "reference": "reference",
    "ref": "reference",
    "database": "reference",
    "query": "query",
    "queries": "query",
}
_TRUTHS = ("ground_truth.json", "ground_truth.csv", "ground_truth.npy")
_ONLY_IMAGES = tuple(suffix for suffix in IMAGE_SUFFIXES if suffix not in LABEL_SUFFIXES)


@dataclass(frozen=True)
class Folders(Layout):
    """A layout whose sequences are the folders in a folder, or the folder itself."""

    name: str = "folders"
    origin: str = ""
    expected: str = (
        "folders of label maps (.png, .npy, .tif, .bmp) or images (.jpg), one per sequence"
    )

    def recognises(self, root: Path) -> bool:
        """Whether a folder holds frames, or one in it."""
        return bool(_sequences(root))

    def read(self, root: Path, labels_as: LabelsAs = None) -> Dataset:
        """The sequences in a folder, or the sequence that it is."""
        truth = next((root / name for name in _TRUTHS if (root / name).is_file()), None)
        frames = list[DatasetFrame]()
        for folder in _sequences(root):
            sequence, place = absolute_folder(folder).name, absolute(folder)
            role = _ROLES.get(sequence.lower())
            images, labels = _frames(folder)
            files, table = labels | images, PoseTable.of_folder(folder)
            for name in sorted(files, key=natural_key):
                file = FrameFile(sequence, name, files[name], folder=place)
                pose = (table and table.pose_of(file)) or UNKNOWN
                paths = images.get(name), labels.get(name)
                frames.append(DatasetFrame(sequence, name, *paths, pose, role))
        file_of_truth = GroundTruth(truth) if truth else None
        return Dataset(self.name, root, tuple(frames), labels_as, file_of_truth)


def _sequences(root: Path) -> list[Path]:
    return [root] if any(_frames(root)) else [f for f in folders_in(root) if any(_frames(f))]


def _frames(folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """The images and the label maps of a sequence."""
    if (folder / "images").is_dir() or (folder / "labels").is_dir():
        return images_in(folder / "images"), labels_in(folder / "labels")
    labels = {name: path for name, path in labels_in(folder).items() if "ground_truth" not in name}
    return labels | files_in(_ONLY_IMAGES, folder), labels
