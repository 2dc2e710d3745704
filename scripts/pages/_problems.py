"""Retrieval problems: drives that are searched among drives, and what counts as right.

CamVid, odd against even: the even frames of all sequences are the references, the odd frames the
queries, and a query's true matches are its neighbours in the drive. CamVid is not part of this
project: its folder holds one folder a sequence with `images`, `labels` and `predicted_espnetv2`.

The synthetic city is mapped once and driven again under every condition, each city searched by
itself; a true match is within 5 m. It is made of label maps, there are no images of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np

from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.datasets.dataset import Dataset, GroundTruth
from ssrvlad_torch.datasets.frame_files import FrameFile, read_ahead
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.datasets.label_files import read_label_map
from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.datasets.segmentation_noise import SegmentationNoise
from ssrvlad_torch.datasets.synthetic_city import REFERENCE, Conditions, SyntheticCity
from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers, from_poses
from ssrvlad_torch.evaluation.ground_truth_files import from_file
from ssrvlad_torch.evaluation.outcomes import Rows
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.taxonomy import label_space

LABELS, IMAGES = "labels", "images"
CAMVID, CITY = "CamVid, odd against even", "Synthetic city"
CITY_LABELS_AS = "cityscapes-trainids"
CITY_FRAMES = 100
CITY_SEEDS = (0, 1, 2)
CITY_SIZE = (240, 320)
CITY_TRUTH = GroundTruth("the city", metres=5.0)


def _drive(**settings: object) -> Conditions:
    return Conditions(**{"spacing": 2.7, "lateral_offset": 0.7, "seed": 1, **settings})


CITY_CONDITIONS = {
    "clean": (_drive(),),
    "noise 2": (_drive(noise=SegmentationNoise(strength=2)),),
    "2 m aside": (_drive(lateral_offset=2.0),),
    "heading +-5": tuple(_drive(heading_offset=degrees) for degrees in (5.0, -5.0)),
    "winter": (_drive(season="winter"),),
    "all together": tuple(
        _drive(
            lateral_offset=2.0,
            heading_offset=degrees,
            season="winter",
            traffic=3.0,
            noise=SegmentationNoise(strength=2),
        )
        for degrees in (5.0, -5.0)
    ),
}
"""All have other traffic than the reference and are 0.7 m to its left."""


class Drive(Protocol):
    """Frames in order, which can be iterated several times."""

    @property
    def stamp(self) -> str:
        """Text that changes with the frames."""

    @property
    def places(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Ids of the frames, and ``(n, 3)`` poses, NaN where unknown."""

    def __iter__(self) -> Iterator[Frame]: ...


def stamp_of(path: Path) -> tuple[int, int]:
    """Size and time of a file."""
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns


@dataclass(frozen=True)
class DriveOnDisk:
    """Label maps of a label space, or images: read as they are, or through a segmenter."""

    files: tuple[FrameFile, ...]
    labels_as: str | None = None
    segmenter: Segmenter | None = None

    @property
    def stamp(self) -> str:
        files = [(file.frame, *stamp_of(file.path)) for file in self.files]
        network = self.segmenter and (self.segmenter.network.digest(), self.segmenter.config)
        return repr((files, self.labels_as, network))

    @property
    def places(self) -> tuple[tuple[str, ...], np.ndarray]:
        poses = np.array([file.pose for file in self.files], np.float64).reshape(-1, 3)
        return tuple(file.frame for file in self.files), poses

    def __iter__(self) -> Iterator[Frame]:
        contents = (
            self.segmenter.label_maps(self.files)
            if self.segmenter
            else read_ahead(self._read, self.files, workers=1, ahead=8)
        )
        for file, content in contents:
            if isinstance(content, ValueError):
                raise ValueError(f"{file.path}: {content}")
            if self.labels_as:
                yield Frame(file.frame, content, self.labels_as)
            else:
                yield Frame(file.frame, image=content)

    def _read(self, file: FrameFile) -> np.ndarray:
        if self.labels_as:
            return read_label_map(file, label_space(self.labels_as))
        return read_image(file)


@dataclass(frozen=True)
class CityDrive:
    """A drive through the synthetic city, drawn when its frames are first used."""

    seed: int
    conditions: Conditions
    frames: int
    size: tuple[int, int] = CITY_SIZE

    @property
    def stamp(self) -> str:
        return repr(self)

    @property
    def places(self) -> tuple[tuple[str, ...], np.ndarray]:
        ids, poses, _ = _painted(self)
        return ids, poses

    def __iter__(self) -> Iterator[Frame]:
        ids, _, maps = _painted(self)
        return (Frame(*frame, CITY_LABELS_AS) for frame in zip(ids, maps, strict=True))


@cache
def _painted(drive: CityDrive) -> tuple[tuple[str, ...], np.ndarray, list[np.ndarray]]:
    traverse = SyntheticCity(drive.seed).traverse(drive.frames, drive.conditions, drive.size)
    frames = list(traverse)
    ids = tuple(f"city{drive.seed}/{frame.name}" for frame in frames)
    return ids, np.array([frame.pose for frame in frames]), [frame.labels for frame in frames]


@dataclass(frozen=True)
class Search:
    """Queries, the references among which they are searched, and the ground truth."""

    queries: Drive
    references: Drive
    ground_truth: GroundTruth

    @property
    def stamp(self) -> str:
        """Text that changes with the frames and the ground truth."""
        file = self.ground_truth.file and stamp_of(self.ground_truth.file)
        return f"{self.queries.stamp} {self.references.stamp} {self.ground_truth} {file}"

    @property
    def truth(self) -> list[Rows]:
        """Rows of the references that are true matches, for each query.

        Raises:
            ValueError: the ground truth does not fit the frames.
        """
        (queries, here), (references, there) = self.queries.places, self.references.places
        if self.ground_truth.metres is not None:
            return from_poses(here, there, self.ground_truth.metres)
        if self.ground_truth.frames is not None:
            return from_frame_numbers(queries, references, self.ground_truth.frames)
        known = from_file(self.ground_truth.file, queries, references)
        return [np.zeros(0, np.int64) if rows is None else rows for rows in known]


@dataclass(frozen=True)
class Problem:
    """Searches whose queries count together.

    Attributes:
        dataset, condition: its name in the pages.
        gives: `LABELS` or `IMAGES`, what its frames have.
        searches: each has its own references.
    """

    dataset: str
    condition: str
    gives: str
    searches: tuple[Search, ...]

    @property
    def name(self) -> str:
        return f"{self.dataset}: {self.condition}"

    @property
    def stamp(self) -> str:
        """A digest that changes with the frames and the ground truth."""
        text = "\n".join(search.stamp for search in self.searches)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def camvid_problems(folder: Path) -> list[Problem]:
    """Hand-made labels, a network's labels against them, and the images.

    Raises:
        ValueError: the folder does not hold CamVid.
    """
    by_hand = open_dataset(folder, "camvid")
    predicted = by_hand.with_labels(Path("predicted_espnetv2"), "cityscapes-trainids")
    labels, network = (_odd_and_even(part, LABELS) for part in (by_hand, predicted))
    images = _odd_and_even(by_hand, IMAGES)
    return [
        Problem(CAMVID, name, gives, (Search(queries, references, by_hand.truth),))
        for name, gives, queries, references in (
            ("labels -> labels", LABELS, labels[0], labels[1]),
            ("espnetv2 -> labels", LABELS, network[0], labels[1]),
            ("images -> images", IMAGES, images[0], images[1]),
        )
    ]


def _odd_and_even(dataset: Dataset, kind: str) -> tuple[DriveOnDisk, DriveOnDisk]:
    files = dataset.label_files if kind == LABELS else dataset.image_files
    space = dataset.labels_as if kind == LABELS else None
    odd, even = (DriveOnDisk(tuple(files(every=2, start=start)), space) for start in (1, 0))
    return odd, even


def city_problems(names: Iterable[str]) -> list[Problem]:
    """Problems of the named `CITY_CONDITIONS`."""
    return [
        Problem(
            CITY,
            name,
            LABELS,
            tuple(
                Search(
                    CityDrive(seed, conditions, CITY_FRAMES),
                    CityDrive(seed, REFERENCE, CITY_FRAMES),
                    CITY_TRUTH,
                )
                for seed in CITY_SEEDS
                for conditions in CITY_CONDITIONS[name]
            ),
        )
        for name in names
    ]


def image_problem(name: str, queries: Dataset, references: Dataset) -> Problem:
    """A problem of the images of two parts of a data set."""
    here, there = (DriveOnDisk(tuple(part.image_files())) for part in (queries, references))
    return Problem(
        name, "images -> images", IMAGES, (Search(here, there, ground_truth_of(queries)),)
    )


def label_problem(
    name: str, queries: Dataset, references: Dataset, segmenter: Segmenter | None
) -> Problem:
    """A problem of label maps of two parts of a data set: their own, or those of a segmenter."""
    parts = (queries, references)
    if segmenter:
        space, condition = segmenter.label_space.name, "segmented -> segmented"
        files: Sequence[Sequence[FrameFile]] = [part.image_files() for part in parts]
    else:
        space, condition = str(queries.labels_as), "labels -> labels"
        files = [part.label_files() for part in parts]
    here, there = (DriveOnDisk(tuple(part), space, segmenter) for part in files)
    return Problem(name, condition, LABELS, (Search(here, there, ground_truth_of(queries)),))


def ground_truth_of(dataset: Dataset) -> GroundTruth:
    """The ground truth of a data set.

    Raises:
        ValueError: it has none.
    """
    if dataset.truth is None:
        raise ValueError("; ".join(dataset.notes) or f"{dataset.root} has no ground truth")
    return dataset.truth
