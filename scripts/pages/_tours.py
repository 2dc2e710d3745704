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
from ssrvlad_torch.datasets.synthetic_city import (
    TOUR,
    TOUR_ESTATES,
    CityFrame,
    Conditions,
    SyntheticCity,
)
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
    return torch.cat([head().sweep(batch, COLUMNS) for batch in labels.split(BATCH)])


@cache
def head() -> SSRVLAD:
    return SSRVLAD.from_preset("default", labels_as=LABELS_AS)
