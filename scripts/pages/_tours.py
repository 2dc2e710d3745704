"""Descriptors and ground truth of tours through synthetic cities, for a loop detector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from conditions import kept
from torch import Tensor

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.city.streets import street
from ssrvlad_torch.datasets.synthetic_city import (
    TOUR,
    TOUR_ESTATES,
    CityFrame,
    Conditions,
    SyntheticCity,
)
from ssrvlad_torch.evaluation.loops import FACING
from ssrvlad_torch.loops.detector import COLUMNS

LABELS_AS = "cityscapes-trainids"
BATCH = 16
CONDITIONS = {
    "perfect labels": Conditions(),
    "noisy labels": Conditions(heading_jitter=2.0, noise=1.0, seed=1),
}


@dataclass(frozen=True)
class Tour:
    """A drive along `synthetic_city.TOUR`, N frames.

    Attributes:
        city: its seed.
        descriptors: ``(N, S, 480)`` float32, from the anchors of a `LoopDetector`.
        poses: ``(N, 3)``.
    """

    city: int
    descriptors: Tensor
    poses: np.ndarray

    def comes_back(self, exclude: int, metres: float, opposite: bool = False) -> np.ndarray:
        """``(N,)`` bool, whether an earlier frame, except the last ``exclude``, is within `metres`
        and looks in the same direction, or in the opposite direction."""
        x, y, turn = (self.poses[:, None] - self.poses).transpose(2, 0, 1)
        ahead = -np.cos(turn) if opposite else np.cos(turn)
        same = (np.hypot(x, y) <= metres) & (ahead > np.cos(FACING))
        return np.tril(same, -exclude - 1).any(axis=1)

    def in_estate(self) -> np.ndarray:
        """``(N,)`` bool, frames in the housing estate."""
        _, y, heading = self.poses.T
        streets = [street(self.city, 1, number) for number in TOUR_ESTATES]
        on_one = np.any([np.abs(y - each.position) < each.width / 2 for each in streets], axis=0)
        return on_one & (np.abs(np.cos(heading)) > np.cos(FACING))


Tours = dict[str, list[Tour]]
"""Tours by their condition."""


def all_tours(cities: Sequence[int], cached: Path) -> Tours:
    """A tour through each city under each condition, kept in a folder."""
    version = head().config.fingerprint
    tours: Tours = {name: [] for name in CONDITIONS}
    for name, city in product(tours, cities):
        made = partial(render, city, name)
        tours[name].append(kept(cached / f"tour {city} {name} {version}.pt", made))
    return tours


def render(city: int, condition: str) -> Tour:
    traverse = SyntheticCity(city, TOUR_ESTATES).traverse(5000, CONDITIONS[condition], turns=TOUR)
    frames = list(traverse)
    print(f"city {city}, {condition}: {len(frames)} frames", flush=True)
    return Tour(city, swept(frames), np.array([frame.pose for frame in frames]))


def swept(frames: Iterable[CityFrame]) -> Tensor:
    """``(N, S, 480)``, from the anchors of a detector."""
    labels = torch.from_numpy(np.stack([frame.labels for frame in frames]))
    return torch.cat([head().sweep(part, COLUMNS) for part in labels.split(BATCH)])


@cache
def head() -> SSRVLAD:
    return SSRVLAD.from_preset("default", labels_as=LABELS_AS)
