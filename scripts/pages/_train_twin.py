"""Accuracy and cost of `SoftSSRVLAD`: tables for docs/training.md."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from _markdown import head_row, paragraph, processor, row
from _train_data import SPACE, Drive
from torch import Tensor
from torch.nn.functional import interpolate

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.config import AREA_LAYERS
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.soft.descriptor import SoftSSRVLAD
from ssrvlad_torch.stages.boundaries import DIRECTIONS
from ssrvlad_torch.taxonomy import CATEGORIES

PRESETS = ("paper", "default")
TEMPERATURES = (0.1, 1.0, 2.0)
FRAMES = 20
CITY_SPACE = "cityscapes-trainids"
UNLABELLED = 255

WHAT = """The mean cosine between the descriptor of `SoftSSRVLAD` and the exact descriptor, for the
whole descriptor and for each of its parts, over the frames that have the part: the eight categories
of `paper`; the areas of six categories and the boundaries of `default`. Label maps are given as
one-hot class scores. `SSRVLAD(..., surrogate=True)` uses the gradient at temperature 1."""

BOUNDARIES = "boundaries"
COLUMNS = (*CATEGORIES, BOUNDARIES)


def agreement(drives: dict[str, Drive]) -> Iterator[str]:
    """The section on accuracy."""
    yield "## Accuracy of SoftSSRVLAD\n"
    yield paragraph(WHAT)
    maps = {
        name: (drive.labels[:: -(-len(drive.labels) // FRAMES)], SPACE, 12)
        for name, drive in drives.items()
    }
    maps["synthetic city"] = (_city(), CITY_SPACE, 19)
    yield from head_row("label maps", "preset", "temperature", "descriptor", *COLUMNS)
    for name, (labels, space, classes) in maps.items():
        for preset in PRESETS:
            head = SSRVLAD.from_preset(preset, labels_as=space)
            hard = torch.cat([head(part) for part in labels.split(4)])
            for temperature in TEMPERATURES:
                soft = _described(SoftSSRVLAD(head.config, temperature), labels, classes)
                cosines = _cosines(soft, hard, _parts(head.config))
                yield row(name, preset, f"{temperature:g}", *cosines)
    yield ""


def _city() -> Tensor:
    """``(FRAMES, 240, 320)`` label maps of a drive through the synthetic city."""
    frames = SyntheticCity(0).traverse(FRAMES, size=(240, 320), labels_as=CITY_SPACE)
    return torch.from_numpy(np.stack([frame.labels for frame in frames]))


@torch.no_grad()
def _parts(config: SSRVLADConfig) -> dict[str, int]:
    """The lengths of the parts of a descriptor, by name."""
    if config.aggregation != "harmonics":
        return dict.fromkeys(CATEGORIES, config.length // len(CATEGORIES))
    areas = dict.fromkeys(CATEGORIES[:AREA_LAYERS], config.harmonics)
    names = (f"{direction} boundaries" for direction in DIRECTIONS)
    return {**areas, **dict.fromkeys(names, config.boundary_harmonics)}


def _described(twin: SoftSSRVLAD, labels: Tensor, classes: int) -> Tensor:
    """Descriptors of one-hot scores; unlabelled pixels are zero in every class."""
    ids = torch.arange(classes).view(1, -1, 1, 1)
    return torch.cat([twin((part[:, None] == ids).float()) for part in labels.split(4)])


def _cosines(soft: Tensor, hard: Tensor, parts: Mapping[str, int]) -> Iterator[str]:
    """Mean cosine of the whole, and of each part over the frames whose exact part is not zero."""
    yield f"{float(torch.cosine_similarity(soft, hard).mean()):.3f}"
    lengths = Counter[str]()
    for name, length in parts.items():
        lengths[name if name in CATEGORIES else BOUNDARIES] += length
    means = {}
    for column, *pair in zip(
        lengths, *(v.split([*lengths.values()], 1) for v in (soft, hard)), strict=True
    ):
        cosines = torch.cosine_similarity(*pair)[pair[1].any(1)]
        if len(cosines):
            means[column] = f"{float(cosines.mean()):.3f}"
    yield from (means.get(column, "-") for column in COLUMNS)


def cost() -> Iterator[str]:
    """The section on memory and time."""
    yield "## Cost of SoftSSRVLAD\n"
    yield paragraph(
        "A batch of eight at 128 x 256 with 19 classes, forward and backward. Each row is a new "
        "process: the fastest of eight rounds, and the peak memory of the whole process with "
        f"torch. {processor().replace('one thread of a', 'A')}. Processor seconds are the sum over "
        "all threads, with waiting."
    )
    yield from head_row("preset", "threads", "seconds", "processor seconds", "memory, GB")
    for preset in PRESETS:
        for threads in (1, 2):
            command = [sys.executable, __file__, preset]
            environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
            done = subprocess.run(
                command, capture_output=True, text=True, check=True, env=environment
            )
            figures = (f"{float(figure):.2f}" for figure in done.stdout.split())
            yield row(preset, str(threads), *figures)
    yield ""


def page_parts(drives: dict[str, Drive]) -> Iterator[str]:
    """Both sections."""
    yield from agreement(drives)
    yield from cost()


def _training_step(preset: str) -> tuple[float, float, float]:
    """Seconds and processor seconds of the fastest of eight rounds, and gigabytes of memory."""
    coarse = torch.randn(8, 19, 8, 16, generator=torch.Generator().manual_seed(0)) * 5
    scores = interpolate(coarse, size=(128, 256), mode="bilinear").requires_grad_()
    twin, walls, processors = SoftSSRVLAD(SSRVLADConfig.from_preset(preset)), [], []
    for _ in range(8):
        wall, processor_time = time.perf_counter(), time.process_time()
        twin(scores).square().sum().backward()
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor_time)
    status = Path("/proc/self/status").read_text().split()
    return min(walls), min(processors), int(status[status.index("VmHWM:") + 1]) * 1024 / 1e9


if __name__ == "__main__":
    print(*_training_step(sys.argv[1]))
