"""Layers of networks as loops over NumPy arrays: what the tests hold the real ones against."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def convolve(
    maps: Array, weight: Array, bias: Array, stride: int = 1, padding: int = 0, groups: int = 1
) -> Array:
    """``(C, H, W)`` maps and ``(out, C / groups, h, w)`` kernels."""
    maps = np.pad(maps, ((0, 0), (padding, padding), (padding, padding)))
    outputs, inputs, high, wide = weight.shape
    rows = (maps.shape[1] - high) // stride + 1
    columns = (maps.shape[2] - wide) // stride + 1
    result = np.empty((outputs, rows, columns))
    for o in range(outputs):
        group = o // (outputs // groups)
        part = maps[group * inputs : (group + 1) * inputs]
        for y in range(rows):
            for x in range(columns):
                window = part[:, y * stride : y * stride + high, x * stride : x * stride + wide]
                result[o, y, x] = (window * weight[o]).sum() + bias[o]
    return result


def max_pool(maps: Array, side: int, stride: int) -> Array:
    rows = (maps.shape[1] - side) // stride + 1
    columns = (maps.shape[2] - side) // stride + 1
    result = np.empty((len(maps), rows, columns))
    for y in range(rows):
        for x in range(columns):
            window = maps[:, y * stride : y * stride + side, x * stride : x * stride + side]
            result[:, y, x] = window.max(axis=(1, 2))
    return result


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
