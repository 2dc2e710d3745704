"""The golden pair: an input that every exported file carries, and the module's outputs for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ..descriptor import SSRVLAD

SIZE = (2, 133, 171)
"""Images, rows and columns: more than the working size of a preset, and nothing divides them."""

_PATCHES = 40
_SPECKS = 60


def golden_pair(head: SSRVLAD, input: str, dtype: str) -> dict[str, npt.NDArray[Any]]:
    """Label maps of patches and specks of all ids, as ids or as class scores, and what is made of
    them.

    Args:
        head: the method.
        input: ``"labels"`` or ``"logits"``.
        dtype: of the labels.

    Returns:
        the input and the outputs ``descriptor``, ``keypoints`` and ``unknown`` by name.

    Raises:
        ValueError: the dtype holds no id of the label space.
    """
    space = head.label_space
    ids = np.array([label.id for label in space.classes])
    if input == "logits":
        ids = np.arange(space.channel_counts[-1])
    elif dtype == "uint8":
        ids = ids[(ids >= 0) & (ids < 256)]
    if ids.size == 0:
        raise ValueError(f"label space {space.name} has no id from 0 to 255; expected dtype int64")
    labels = _patches(ids)
    given: npt.NDArray[Any] = labels.astype(dtype)
    if input == "logits":
        given = np.eye(len(ids), dtype=np.float32)[:, labels].swapaxes(0, 1).copy()
    view = head.explain(torch.from_numpy(given))
    return {
        input: given,
        "descriptor": head(torch.from_numpy(given)).numpy(),
        "keypoints": view.keypoints.sum((2, 3)).numpy(),
        "unknown": np.zeros(len(labels), np.int64),
    }


def _patches(ids: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """``(B, H, W)``: every pixel has the id of the nearest of some random points, or is a speck."""
    _, height, width = SIZE
    rng = np.random.default_rng(0)
    ids = rng.permutation(ids)
    labels = np.empty(SIZE, np.int64)
    for number, image in enumerate(labels):
        y, x = rng.uniform(0, height, _PATCHES), rng.uniform(0, width, _PATCHES)
        rows, columns = np.mgrid[:height, :width]
        nearest = np.hypot(rows[..., None] - y, columns[..., None] - x).argmin(-1)
        image[:] = ids[(nearest + number * _PATCHES) % len(ids)]
        specks = rng.integers(0, image.size, _SPECKS)
        image.flat[specks] = rng.choice(ids, _SPECKS)
    return labels
