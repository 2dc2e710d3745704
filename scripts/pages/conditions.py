"""Drives that pages measure, and what is kept of them on disk.

CamVid is not part of this project: its folder has one folder per sequence with `images`, `labels`,
`predicted_espnetv2` and `predicted_dicenet`. Real traverses are folders with `images` and the label
maps of two networks, `predicted_espnetv2` and `predicted_dabnet`. The synthetic city is driven once
as reference and once under every condition; each city is searched alone, and a true match is within
5 m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.image_files import decode_image, find_image_files
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.names import sequence_of
from ssrvlad_torch.datasets.synthetic_city import Conditions, SyntheticCity
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.taxonomy import label_space

RESAMPLES = 1000
BATCH = 16
METRES = 5.0
CITY_SEEDS = (0, 1, 2)
TRAIN_IDS = "cityscapes-trainids"
NETWORKS = ("espnetv2", "dabnet")
REAL = {
    "UofA": {"evening -> day": ("uofa/evening", "uofa/day", 1)},
    "Gardens Point": {
        "right -> left": ("gardens_walk/day_right", "gardens_walk/day_left", 2),
        "night -> right": ("gardens_walk/night_right", "gardens_walk/day_right", 2),
        "night -> left": ("gardens_walk/night_right", "gardens_walk/day_left", 2),
    },
}
"""Queries, references, and the largest distance of a true match in rows."""

ROUTES = {name: route for routes in REAL.values() for name, route in routes.items()}
CAMVID_CONDITIONS = {
    "labels -> labels": ("labels", "labels"),
    "espnetv2 -> labels": ("predicted_espnetv2", "labels"),
    "dicenet -> espnetv2": ("predicted_dicenet", "predicted_espnetv2"),
    "espnetv2 -> espnetv2": ("predicted_espnetv2", "predicted_espnetv2"),
}


def _drive(**settings: object) -> Conditions:
    return Conditions(**{"spacing": 2.7, "lateral_offset": 0.7, "seed": 1, **settings})


CITY_CONDITIONS: dict[str, list[Conditions]] = {
    "clean": [_drive()],
    **{f"noise {s}": [_drive(noise=float(s))] for s in (1, 2, 4)},
    **{f"{m:g} m aside": [_drive(lateral_offset=float(m))] for m in (0.5, 1, 2, 4)},
    **{f"heading +-{d}": [_drive(heading_offset=float(h)) for h in (d, -d)] for d in (5, 10)},
    "winter": [_drive(season="winter")],
    "heavy traffic": [_drive(traffic=3.0)],
    "all together": [
        _drive(
            lateral_offset=2.0,
            heading_offset=float(heading),
            season="winter",
            traffic=3.0,
            noise=2.0,
        )
        for heading in (5, -5)
    ],
}
"""All have other traffic than the reference and are 0.7 m to its left."""


class Search(NamedTuple):
    """Queries, references and true matches, by names of drives and rows of them."""

    queries: str
    references: str
    truth: list[np.ndarray]
    query_rows: list[int] | None = None
    reference_rows: list[int] | None = None


@dataclass(frozen=True)
class Drive:
    """Frames of a drive: ids, poses ``(n, 3)``, label maps ``(n, H, W)`` and their label space,
    pictures. The city has no pictures, and some data sets no label maps."""

    frames: tuple[str, ...]
    poses: np.ndarray
    maps: np.ndarray | None = None
    labels_as: str | None = None
    pictures: tuple[Path, ...] = ()

    def seen(self, rows: Sequence[int] | None = None) -> Iterator[View]:
        """Frames for a method, all or some."""
        for row in range(len(self.frames)) if rows is None else rows:
            labels = None if self.maps is None else self.maps[row]
            picture = decode_image(self.pictures[row].read_bytes()) if self.pictures else None
            yield View(self.frames[row], labels, self.labels_as, picture)


def labelled(files: Sequence[FrameFile], labels_as: str, pictures: Sequence[Path] = ()) -> Drive:
    """A drive of label maps on disk."""
    space = label_space(labels_as)
    maps = np.stack([read_label_map(file, space) for file in files])
    return Drive(*places_of(files), maps, labels_as, tuple(pictures))


def pictured(files: Sequence[FrameFile], segmenter: Segmenter | None = None) -> Drive:
    """A drive of pictures, with the label maps of a network if there is one.

    Raises:
        ValueError: the network cannot label a picture.
    """
    paths = tuple(file.path for file in files)
    if segmenter is None:
        return Drive(*places_of(files), pictures=paths)
    maps = []
    for file, labels in segmenter.label_maps(files):
        if isinstance(labels, ValueError):
            raise ValueError(f"{file.path}: {labels}")
        maps.append(labels)
    return Drive(*places_of(files), np.stack(maps), segmenter.label_space.name, paths)


def pictures_of(data: Path, folder: str) -> list[FrameFile]:
    """The pictures of a real drive."""
    images = data / folder / "images"
    return find_image_files([str(images if images.is_dir() else data / folder)])


def places_of(files: Sequence[FrameFile]) -> tuple[tuple[str, ...], np.ndarray]:
    """Ids and poses ``(n, 3)``."""
    poses = np.array([file.pose for file in files], np.float64).reshape(-1, 3)
    return tuple(file.frame for file in files), poses


@cache
def camvid(folder: Path, kind: str) -> Drive:
    """All sequences of CamVid, each named as its folder."""
    files: list[FrameFile] = []
    for sequence in sorted(path.name for path in folder.iterdir() if path.is_dir()):
        files += find_label_files([str(folder / sequence / kind)], sequence)
    pictures = [folder / file.sequence / "images" / f"{file.name}.jpg" for file in files]
    return labelled(files, "camvid-11" if kind == "labels" else TRAIN_IDS, pictures)


@cache
def real(folder: Path, network: str) -> Drive:
    """A real traverse with the label maps of a network, or with the ``labels`` of CamVid; one that
    lacks those of the network has those of DiceNet."""
    maps = folder / ("labels" if network == "labels" else f"predicted_{network}")
    if not maps.is_dir():
        maps = folder / "predicted_dicenet"
    files = find_label_files([str(maps)], folder.name)
    pictures = [next((folder / "images").glob(f"{file.name}.*")) for file in files]
    return labelled(files, "camvid-11" if network == "labels" else TRAIN_IDS, pictures)


@cache
def city(
    seed: int, conditions: Conditions, frames: int = 100, size: tuple[int, int] = (240, 320)
) -> Drive:
    """One drive through one city."""
    drawn = list(SyntheticCity(seed).traverse(frames, conditions, size))
    return Drive(
        tuple(f"city{seed}/{frame.name}" for frame in drawn),
        np.array([frame.pose for frame in drawn]),
        np.stack([frame.labels for frame in drawn]),
        TRAIN_IDS,
    )


def near_rows(queries: int, references: int, reach: int) -> list[np.ndarray]:
    """True matches of drives whose rows show the same places: up to a distance in rows."""
    return [np.flatnonzero(abs(np.arange(references) - row) <= reach) for row in range(queries)]


def every_other(frames: Sequence[str], start: int) -> list[int]:
    """Rows of every second frame of each sequence, from frame ``start``."""
    sequences = np.array([sequence_of(frame) for frame in frames])
    chosen = [np.flatnonzero(sequences == name)[start::2] for name in dict.fromkeys(sequences)]
    return np.concatenate(chosen).tolist()


def kept(file: Path, make: Callable[[], Any]) -> Any:
    """What was made, kept in a file: an interrupted run can be resumed."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(".tmp")
        torch.save(make(), temporary)
        temporary.replace(file)
        print(file.stem, flush=True)
    return torch.load(file, weights_only=False)
