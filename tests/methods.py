"""Frames that methods encode, and layers of networks on NumPy arrays, window by window."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

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


Array = npt.NDArray[np.float64]


def convolve(
    maps: Array, weight: Array, bias: Array, stride: int = 1, padding: int = 0, groups: int = 1
) -> Array:
    """``(C, H, W)`` maps and ``(out, C / groups, h, w)`` kernels."""
    maps = np.pad(maps, ((0, 0), (padding, padding), (padding, padding)))
    windows = sliding_window_view(maps, weight.shape[2:], (1, 2))[:, ::stride, ::stride]
    parts = zip(np.split(windows, groups), np.split(weight, groups), strict=True)
    sums = [np.einsum("cyxhw,ochw->oyx", *part) for part in parts]
    return np.concatenate(sums) + bias[:, None, None]


def max_pool(maps: Array, side: int, stride: int) -> Array:
    windows = sliding_window_view(maps, (side, side), (1, 2))
    return windows[:, ::stride, ::stride].max((3, 4))


def local_response_norm(maps: Array, size: int, alpha: float, beta: float) -> Array:
    """Krizhevsky et al., NIPS 2012, with Caffe's alpha over size."""
    result = np.empty_like(maps)
    for c in range(len(maps)):
        near = maps[max(0, c - size // 2) : c + size // 2 + 1]
        result[c] = maps[c] / (1 + alpha / size * (near**2).sum(axis=0)) ** beta
    return result


def relu(maps: Array) -> Array:
    return np.maximum(maps, 0)


def unit(vector: Array) -> Array:
    """Of length 1."""
    return vector / np.sqrt((vector**2).sum())
