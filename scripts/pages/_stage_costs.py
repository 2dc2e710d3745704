"""What each stage of the native core costs beside memory speed, OpenCV, scikit-image and cc3d."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import cc3d
import cv2
import numpy as np
import torch
from _markdown import head_row, row
from skimage import measure, morphology
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, native
from ssrvlad_torch.cli.bench import time_in_turn
from ssrvlad_torch.stages.bitplanes import pack

COPIED = 1 << 28
Way = Callable[[], Any]


def stage_table(labels: Tensor, config: SSRVLADConfig, repetitions: int) -> Iterator[str]:
    """The table of one label map and the settings of a preset at native size."""
    height, width = labels.shape[1:]
    source, target = np.ones(COPIED, np.uint8), np.zeros(COPIED, np.uint8)
    stages = _stages(labels, config)
    ways = {"copy": partial(np.copyto, target, source)}
    ways |= {f"{stage} {way}": run for stage, own in stages.items() for way, run in own.items()}
    taken = {k: v.milliseconds["median"] for k, v in time_in_turn(ways, repetitions).items()}
    touched = 2 * height * width
    copied = taken["copy"] * touched / (2 * COPIED)
    rivals = ("OpenCV", "scikit-image", "cc3d")
    yield from head_row("stage", "native core", *rivals, "at memory speed", "core / copy")
    for stage, own in stages.items():
        cells = [f"{taken[f'{stage} {r}']:.2f}" if r in own else "" for r in rivals]
        here = taken[f"{stage} native core"]
        yield row(stage, f"{here:.2f}", *cells, f"{copied:.2f}", f"{here / copied:.0f}")


def _stages(labels: Tensor, config: SSRVLADConfig) -> dict[str, dict[str, Way]]:
    """Every stage and the ways to do it, by name."""
    view = SSRVLAD(config).explain(labels)
    layers, clean = view.layers[0].numpy(), view.clean_layers[0].numpy()
    size = layers.shape[1:]
    radius = config.radius_pixels(config.closing, *size)
    hole, region = (config.area_pixels(a, *size) for a in (config.hole_area, config.region_area))
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    bytes_of = [layer.astype(np.uint8) for layer in layers]
    padded = [np.pad(layer, 2).astype(np.uint8) * 255 for layer in clean]
    one_map = (clean * np.arange(1, 9)[:, None, None]).max(0).astype(np.uint8)
    return {
        "closing": {
            "native core": _native("open_and_close", view.layers, 0, radius),
            "OpenCV": _each(bytes_of, lambda x: cv2.morphologyEx(x, cv2.MORPH_CLOSE, square)),
        },
        "filling holes": {
            "native core": _native("fill_holes", view.layers, hole),
            "OpenCV": _each(
                bytes_of, lambda x: cv2.connectedComponentsWithStats(1 - x, connectivity=4)
            ),
            "scikit-image": _each(
                layers, lambda x: morphology.remove_small_holes(x, max_size=hole - 1)
            ),
        },
        "dropping regions": {
            "native core": _native("drop_regions", view.layers, region),
            "OpenCV": _each(
                bytes_of, lambda x: cv2.connectedComponentsWithStats(x, connectivity=8)
            ),
            "scikit-image": _each(layers, partial(measure.label, connectivity=2)),
            "cc3d": partial(cc3d.connected_components, one_map, connectivity=8),
        },
        "thinning": {
            "native core": _native("thin", view.clean_layers, 0),
            "OpenCV": _each(padded, cv2.ximgproc.thinning),
            "scikit-image": _each(clean, morphology.skeletonize),
        },
        "keypoints": {"native core": _native("keypoints", view.skeleton, results=2)},
    }


def _each(layers: Any, work: Callable[[Any], Any]) -> Way:
    def run() -> None:
        for layer in layers:
            work(layer)

    return run


def _native(stage: str, masks: Tensor, *arguments: int, results: int = 1) -> Way:
    planes = pack(masks)
    targets = [torch.empty_like(planes) for _ in range(results)]
    pointers = [ctypes.c_void_p(target.data_ptr()) for target in targets]
    function = getattr(native.core().library, f"ssrvlad_{stage}")

    def run() -> list[Tensor]:
        assert function(planes.data_ptr(), *planes.shape, *arguments, *pointers) == 0
        return targets

    return run
