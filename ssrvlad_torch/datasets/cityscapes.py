"""Cityscapes: ``gtFine/train/aachen/aachen_000000_000019_gtFine_labelIds.png``.

Cordts et al., CVPR 2016. A traverse is a city: ``train-aachen``. Label maps hold ids, as published
and with parking and guard rails, or train ids, as the scripts of the data set write them.
``vehicle/`` has the GPS fixes of the frames.
"""

import math
from pathlib import Path

from ..files import read_json
from ..taxonomy import label_space
from .dataset import Dataset, LabelsAs, Layout, Traverse, files_in, folders_in, images_in, labels_in
from .poses import Pose, heading_of_course

_IMAGES = "leftImg8bit"
_ANNOTATIONS = ("gtFine", "gtCoarse")
_ENCODINGS = {"cityscapes-ids": "labelIds", "cityscapes-trainids": "labelTrainIds"}
_EARTH_RADIUS = 6_371_000
_MERIDIAN = 9.0


def read(root: Path, labels_as: LabelsAs) -> Dataset:
    """The data set in ``root``; fine annotations of the label space before coarse ones. The label
    space is that of the label maps on disk, of the ids if both exist or none."""
    cities = _cities(root)
    published = (
        space
        for space, ending in _ENCODINGS.items()
        for kind in _ANNOTATIONS
        if any(any((root / kind / city).glob(f"*_{ending}.png")) for city in cities)
    )
    space = labels_as or next(published, "cityscapes-ids")
    ending = _ENCODINGS.get(label_space(space).name, "labelIds")
    traverses = []
    for city in cities:
        images = images_in(root / _IMAGES / city, f"_{_IMAGES}")
        labels: dict[str, Path] = {}
        for kind in reversed(_ANNOTATIONS):
            labels |= labels_in(root / kind / city, f"_{kind}_{ending}")
        fixes = files_in((".json",), root / "vehicle" / city, "_vehicle")
        poses = {
            name: read_fix(file) for name, file in fixes.items() if name in images or name in labels
        }
        if images or labels:
            traverses.append(Traverse.of(city.replace("/", "-"), images, labels, poses))
    note = (
        f"{root} has no vehicle/, so no frame has a pose; it is vehicle_trainvaltest.zip at "
        f"{LAYOUT.origin}"
    )
    notes = () if (root / "vehicle").is_dir() else (note,)
    return Dataset(LAYOUT.name, root, tuple(traverses), space, None, notes)


def read_fix(path: Path) -> Pose:
    """The pose of one frame in metres of a transverse Mercator projection at 9 degrees east. The
    Earth is a sphere here; distances in the data set have an error of at most 0.5 %. ``gpsHeading``
    is in degrees clockwise from north. A file without a latitude or longitude is a ValueError."""
    try:
        fix = read_json(path)
        phi, along = (math.radians(fix[f"gps{name}"]) for name in ("Latitude", "Longitude"))
        along -= math.radians(_MERIDIAN)
        east = _EARTH_RADIUS * math.atanh(math.cos(phi) * math.sin(along))
        north = _EARTH_RADIUS * math.atan2(math.tan(phi), math.cos(along))
        return Pose(east, north, heading_of_course(fix.get("gpsHeading", math.nan)))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} must hold numbers gpsLatitude, gpsLongitude and gpsHeading: {error!r}"
        ) from error


def _cities(root: Path) -> list[str]:
    """The folders of cities on disk, ``train/aachen`` and so on."""
    cities = {
        f"{split.name}/{city.name}"
        for kind in (_IMAGES, *_ANNOTATIONS)
        for split in folders_in(root / kind)
        for city in folders_in(split)
    }
    return sorted(cities)


LAYOUT = Layout(
    "cityscapes",
    "cityscapes-dataset.com",
    "leftImg8bit/<split>/<city>/*_leftImg8bit.png and gtFine/<split>/<city>/*_gtFine_labelIds.png",
    _cities,
    read,
)
