"""Frames that methods encode; shared by the tests."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from ssrvlad_torch.channels.channel import View

Picture = npt.NDArray[np.uint8]


def picture(seed: int, height: int = 96, width: int = 160, grain: int = 4) -> Picture:
    """Random gray blocks, in colour."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 256, (height // grain, width // grain, 1), np.uint8)
    return blocks.repeat(grain, 0).repeat(grain, 1).repeat(3, 2)


def noise(seed: int, height: int = 32, width: int = 48) -> Picture:
    """A picture of random colours."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def frames(pictures: Iterable[Picture], sequence: str = "a") -> list[View]:
    """Frames of one sequence, by number."""
    return [View(f"{sequence}/{n}", picture=image) for n, image in enumerate(pictures)]
