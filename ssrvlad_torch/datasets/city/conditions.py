"""How a drive through the synthetic city differs from another one, and where chance comes from."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np

from ..segmentation_noise import SegmentationNoise

SEASONS = ("summer", "winter")


@dataclass(frozen=True)
class Conditions:
    """How and when the streets are driven.

    Args:
        spacing: metres driven between frames, along the street's centre line (> 0).
        lateral_offset: metres to the left of the usual lane; the lane has room for about +-1.5.
        heading_offset: degrees by which the camera is turned to the left.
        heading_jitter: standard deviation in degrees of a smooth swaying of the camera.
        traffic: amount of vehicles and people; 0 none, 1 usual, 3 heavy.
        season: "summer", or "winter" when most trees are bare.
        noise: mistakes of a segmentation network, or None for perfect labels.
        seed: of everything that differs from drive to drive (>= 0).
    """

    spacing: float = 3.0
    lateral_offset: float = 0.0
    heading_offset: float = 0.0
    heading_jitter: float = 0.0
    traffic: float = 1.0
    season: str = "summer"
    noise: SegmentationNoise | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("spacing", "lateral_offset", "heading_offset", "heading_jitter", "traffic"):
            require(math.isfinite(getattr(self, name)), name, getattr(self, name), "finite")
        require(self.spacing > 0, "spacing", self.spacing, "metres > 0")
        require(self.heading_jitter >= 0, "heading_jitter", self.heading_jitter, "degrees >= 0")
        require(self.traffic >= 0, "traffic", self.traffic, "a number >= 0")
        require(self.season in SEASONS, "season", self.season, f"one of {SEASONS}")
        require(self.seed >= 0, "seed", self.seed, "an integer >= 0")


def require(holds: bool, name: str, got: object, expected: str) -> None:
    """Raises a `ValueError` that names what was got and expected, unless the condition holds."""
    if not holds:
        raise ValueError(f"{name}: got {got!r}, expected {expected}")


def generator(seed: int, thing: str, *key: int) -> np.random.Generator:
    """Random generator of one thing, independent of all others; the key may be negative."""
    name = zlib.crc32(thing.encode())
    return np.random.default_rng([seed, name, *(number % 2**32 for number in key)])
