"""VPR-Bench (Zaffar et al., IJCV 2021): ``query/``, ``ref/`` and ``ground_truth_new.json``.

Its data sets include parts of SYNTHIA (night to fall) and RobotCar (CrossSeason). The ground truth
names images by their numbers, from 0, in the order of the file names. It is published as a pickle,
``ground_truth_new.npy``, which the user converts, see `ground_truth_files`.
"""

from pathlib import Path

from .dataset import Dataset, GroundTruth, LabelsAs, Layout, Role, Traverse, images_in
from .names import absolute_folder

_FOLDERS: tuple[tuple[str, Role], ...] = (("query", "query"), ("ref", "reference"))
_TRUTHS = ("ground_truth_new.json", "ground_truth_new.npy")


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The data set in ``root``; its truth may be ``<folder>.ground_truth_new.json`` beside it."""
    traverses = []
    for name, role in _FOLDERS:
        images = images_in(root / name)
        if not images:
            raise ValueError(
                f"{root / name} holds no images; the data sets of VPR-Bench are at {LAYOUT.origin}"
            )
        traverses.append(Traverse.of(name, images, labels={}, poses={}, role=role))
    folder = absolute_folder(root)
    candidates = [p for t in _TRUTHS for p in (root / t, folder.with_name(f"{folder.name}.{t}"))]
    file = next((path for path in candidates if path.is_file()), None)
    truth = GroundTruth(file) if file else None
    notes = () if file else (f"{root} has no {_TRUTHS[0]}; see {LAYOUT.origin}",)
    return Dataset(LAYOUT.name, root, tuple(traverses), labels_as, truth, notes)


LAYOUT = Layout(
    "vpr-bench",
    "github.com/MubarizZaffar/VPR-Bench",
    "query/*.jpg, ref/*.jpg and ground_truth_new.json",
    lambda root: all((root / folder).is_dir() for folder, _ in _FOLDERS),
    read,
)
