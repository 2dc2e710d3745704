"""Accuracy and cost of `SoftSSRVLAD`: tables for docs/training.md."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import torch
from _markdown import head_row, paragraph, processor, row
from _train_data import SPACE, Drive
from torch import Tensor

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.soft.descriptor import SoftSSRVLAD
from ssrvlad_torch.taxonomy import CATEGORIES

PRESETS = ("paper", "default")
TEMPERATURES = (0.1, 1.0, 2.0)
FRAMES = 20
CITY_SPACE = "cityscapes-trainids"
UNLABELLED = 255

WHAT = """The mean cosine between the descriptor of `SoftSSRVLAD` and the exact descriptor, for the
whole descriptor and for the block of each category. Label maps are given as one-hot class scores.
`SSRVLAD(..., surrogate=True)` uses the gradient at temperature 1."""

COST = """
import sys, time, torch
from pathlib import Path
from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.soft import SoftSSRVLAD
coarse = torch.randn(8, 19, 8, 16, generator=torch.Generator().manual_seed(0)) * 5
scores = torch.nn.functional.interpolate(coarse, size=(128, 256), mode="bilinear").requires_grad_()
twin, walls, processors = SoftSSRVLAD(SSRVLADConfig.from_preset(sys.argv[1])), [], []
for _ in range(8):
    wall, processor = time.perf_counter(), time.process_time()
    twin(scores).square().sum().backward()
    walls.append(time.perf_counter() - wall)
    processors.append(time.process_time() - processor)
status = Path("/proc/self/status").read_text().split()
print(min(walls), min(processors), int(status[status.index("VmHWM:") + 1]) * 1024 / 1e9)
"""


def agreement(drives: dict[str, Drive]) -> Iterator[str]:
    """The section on accuracy."""
    yield "## Accuracy of SoftSSRVLAD\n"
    yield paragraph(WHAT)
    maps = {
        name: (drive.labels[:: -(-len(drive.labels) // FRAMES)], SPACE, 12)
        for name, drive in drives.items()
    }
    maps["synthetic city"] = (_city(), CITY_SPACE, 19)
    yield from head_row("label maps", "preset", "temperature", "descriptor", *CATEGORIES)
    for name, (labels, space, classes) in maps.items():
        for preset in PRESETS:
            head = SSRVLAD.from_preset(preset, labels_as=space)
            hard = torch.cat([head(part) for part in labels.split(4)])
            for temperature in TEMPERATURES:
                soft = _described(SoftSSRVLAD(head.config, temperature), labels, classes)
                yield row(name, preset, f"{temperature:g}", *_cosines(soft, hard))
    yield ""


def _city() -> Tensor:
    """``(FRAMES, 240, 320)`` label maps of a drive through the synthetic city."""
    frames = SyntheticCity(0).traverse(FRAMES, size=(240, 320), labels_as=CITY_SPACE)
    return torch.from_numpy(np.stack([frame.labels for frame in frames]))


@torch.no_grad()
def _described(twin: SoftSSRVLAD, labels: Tensor, classes: int) -> Tensor:
    """Descriptors of one-hot scores; unlabelled pixels are zero in every class."""
    ids = torch.arange(classes).view(1, -1, 1, 1)
    return torch.cat([twin((part[:, None] == ids).float()) for part in labels.split(4)])


def _cosines(soft: Tensor, hard: Tensor) -> Iterator[str]:
    """Mean cosine of the whole, and of each category's block where the exact one is not zero."""
    yield f"{float(torch.cosine_similarity(soft, hard).mean()):.3f}"
    soft, hard = (one.view(len(one), len(CATEGORIES), -1) for one in (soft, hard))
    cosines, there = torch.cosine_similarity(soft, hard, dim=2), hard.any(2)
    for category in range(len(CATEGORIES)):
        found = cosines[there[:, category], category]
        yield f"{float(found.mean()):.3f}" if len(found) else "-"


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
            command = [sys.executable, "-c", COST, preset]
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
