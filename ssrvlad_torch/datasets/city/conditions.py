"""Conditions of a drive through the synthetic city, and its random generators."""

import math
import zlib
from dataclasses import dataclass

import numpy as np

SEASONS = ("summer", "winter")


@dataclass(frozen=True)
class Conditions:
    """Conditions of a drive.

    Args:
        spacing: metres between frames, along the centre line of the street (> 0).
        lateral_offset: metres to the left of the usual lane; about +-1.5 stay in the lane.
        heading_offset: rotation of the camera to the left in degrees.
        heading_jitter: standard deviation in degrees of a smooth rotation of the camera.
        traffic: amount of vehicles and people; 0 none, 1 usual, 3 heavy.
        season: "summer", or "winter", when most trees are bare.
        noise: strength of the errors of a segmentation network, see `segmentation_noise`; 0 none.
        seed: of all that differs between drives, >= 0.
    """

    spacing: float = 3.0
    lateral_offset: float = 0.0
    heading_offset: float = 0.0
    heading_jitter: float = 0.0
    traffic: float = 1.0
    season: str = "summer"
    noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require(0 < self.spacing < math.inf, "spacing", self.spacing, "metres > 0")
        require(self.season in SEASONS, "season", self.season, f"one of {SEASONS}")


def require(holds: bool, name: str, got: object, expected: str) -> None:
    """Raises a `ValueError` that names the value and what was expected, unless `holds`."""
    if not holds:
        raise ValueError(f"{name}: got {got!r}, expected {expected}")


def generator(seed: int, name: str, *key: int) -> np.random.Generator:
    """An independent random generator for each seed, name and key; the key may be negative."""
    name_hash = zlib.crc32(name.encode())
    return np.random.default_rng([seed, name_hash, *(number % 2**32 for number in key)])
