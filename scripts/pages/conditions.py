"""The conditions under which the pages measure recognition.

camvid-odd-even: the even frames of all sequences are the references, the odd frames the queries,
and the true matches of a query are its neighbours in the drive. CamVid is not part of this project:
its folder has one folder per sequence with `labels`, `predicted_espnetv2` and
`predicted_dicenet`. Without it only the city is measured.

The synthetic city is driven once as reference and once under every condition. Each city is
searched alone, and a true match is within 5 m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, baselines
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.segmentation_noise import SegmentationNoise
from ssrvlad_torch.datasets.synthetic_city import Conditions, SyntheticCity
from ssrvlad_torch.stages.bitplanes import pack
from ssrvlad_torch.taxonomy import label_space

RESAMPLES = 1000
BATCH = 16
METRES = 5.0
CITY_SEEDS = (0, 1, 2)
CITY_FRAMES = 100
CITY_SIZE = (240, 320)
SPACES = {
    "labels": "camvid-11",
    "predicted_espnetv2": "cityscapes-trainids",
    "predicted_dicenet": "cityscapes-trainids",
}
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
    **{f"noise {s}": [_drive(noise=SegmentationNoise(strength=s))] for s in (1, 2, 4)},
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
            noise=SegmentationNoise(strength=2),
        )
        for heading in (5, -5)
    ],
}
"""All have other traffic than the reference and are 0.7 m to its left."""


@dataclass(frozen=True)
class Drive:
    """Frames of a drive: ids, poses, label maps ``(n, H, W)``, their label space, pictures."""

    frames: tuple[str, ...]
    poses: np.ndarray
    maps: np.ndarray
    labels_as: str
    pictures: tuple[Path, ...] = ()

    @property
    def sequences(self) -> tuple[str, ...]:
        return tuple(frame.rpartition("/")[0] for frame in self.frames)


Describe = Callable[[Drive], Tensor]
"""A drive's descriptors, ``(n, D)``."""


def described_by(config: SSRVLADConfig) -> Describe:
    """SSR-VLAD with some settings."""
    heads = {space: SSRVLAD(_as(config, space)) for space in set(SPACES.values())}

    def describe(drive: Drive) -> Tensor:
        batches = torch.from_numpy(drive.maps).split(BATCH)
        return torch.cat([heads[drive.labels_as](batch) for batch in batches])

    return describe


def described_by_baseline(name: str) -> Describe:
    """A method of label maps."""
    method = baselines.make(name)

    def describe(drive: Drive) -> Tensor:
        frames = zip(drive.frames, drive.maps, strict=True)
        found: Tensor = method.encode_query(
            baselines.Frame(frame, labels, drive.labels_as) for frame, labels in frames
        )
        return found

    return describe


class Masks(NamedTuple):
    """What the front end of the preset `default` leaves of a drive: ``(n, h, w)`` bit-planes."""

    layers: Tensor
    clean: Tensor
    skeleton: Tensor


def described_from_masks(step: Callable[[Masks], Tensor]) -> Describe:
    """A way to describe that needs no more than the masks, which are made once a drive."""

    def describe(drive: Drive) -> Tensor:
        if id(drive) not in _MASKS:
            _MASKS[id(drive)] = _masks(drive)
        return step(_MASKS[id(drive)])

    return describe


_MASKS: dict[int, Masks] = {}


def _masks(drive: Drive) -> Masks:
    head = SSRVLAD.from_preset("default", labels_as=drive.labels_as)
    views = [head.explain(batch) for batch in torch.from_numpy(drive.maps).split(BATCH)]
    kept = ("layers", "clean_layers", "skeleton")
    return Masks(*(torch.cat([pack(getattr(view, name)) for view in views]) for name in kept))


def _as(config: SSRVLADConfig, space: str) -> SSRVLADConfig:
    return SSRVLADConfig.from_dict({**config.to_dict(), "labels_as": space})


@cache
def camvid(folder: Path, kind: str) -> Drive:
    """All sequences of CamVid, each named as its folder."""
    files: list[FrameFile] = []
    for sequence in sorted(path.name for path in folder.iterdir() if path.is_dir()):
        files += find_label_files([str(folder / sequence / kind)], sequence)
    space = label_space(SPACES[kind])
    return Drive(
        tuple(file.frame for file in files),
        np.full((len(files), 3), np.nan),
        np.stack([read_label_map(file, space) for file in files]),
        SPACES[kind],
        tuple(folder / file.sequence / "images" / f"{file.name}.jpg" for file in files),
    )


@cache
def city(seed: int, conditions: Conditions) -> Drive:
    """One drive through one city."""
    frames = list(SyntheticCity(seed).traverse(CITY_FRAMES, conditions, CITY_SIZE))
    return Drive(
        tuple(f"city{seed}/{frame.name}" for frame in frames),
        np.array([frame.pose for frame in frames]),
        np.stack([frame.labels for frame in frames]),
        "cityscapes-trainids",
    )


def every_other(drive: Drive, start: int) -> list[int]:
    """Of each sequence the rows of frame ``start`` and every second after it."""
    sequences = np.array(drive.sequences)
    chosen = [np.flatnonzero(sequences == name)[start::2] for name in dict.fromkeys(sequences)]
    return np.concatenate(chosen).tolist()
