"""VPR-Bench (Zaffar et al., IJCV 2021): ``query/``, ``ref/`` and ``ground_truth_new.npy``.

Among its data sets are sub-sequences of SYNTHIA (night to fall) and RobotCar (CrossSeason). The
ground truth names images by their places in the order of the file names, from 0.
"""

from __future__ import annotations

from pathlib import Path

from ..files import absolute_folder
from .dataset import Dataset, GroundTruth, Layout, Role, Traverse, files_in
from .image_files import SUFFIXES as IMAGE_SUFFIXES

_FOLDERS: tuple[tuple[str, Role], ...] = (("query", "query"), ("ref", "reference"))
_TRUTH = "ground_truth_new.npy"


def read(root: Path, labels_as: str | None) -> Dataset:
    """The data set in ``root``; the ground truth may also lie beside it, as
    ``<folder>.ground_truth_new.npy``."""
    traverses = []
    for folder, role in _FOLDERS:
        images = files_in(root / folder, IMAGE_SUFFIXES)
        if not images:
            raise ValueError(
                f"{root / folder} holds no images; the data sets of VPR-Bench are at "
                f"{LAYOUT.origin}"
            )
        traverses.append(Traverse.of(folder, images, labels={}, poses={}, role=role))
    home = absolute_folder(root)
    places = (root / _TRUTH, home.parent / f"{home.name}.{_TRUTH}")
    file = next((place for place in places if place.is_file()), None)
    truth = GroundTruth("VPR-Bench", file=file) if file else None
    notes = () if file else (f"{root} has no {_TRUTH}; it is at {LAYOUT.origin}",)
    return Dataset(LAYOUT.name, root, tuple(traverses), labels_as, truth, notes)


LAYOUT = Layout(
    "vpr-bench",
    "github.com/MubarizZaffar/VPR-Bench",
    "query/*.jpg, ref/*.jpg and ground_truth_new.npy",
    lambda root: all((root / folder).is_dir() for folder, _ in _FOLDERS),
    read,
)
