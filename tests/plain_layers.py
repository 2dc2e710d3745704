"""Layers of networks on NumPy arrays, window by window: what the tests hold the real ones
against."""

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

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
