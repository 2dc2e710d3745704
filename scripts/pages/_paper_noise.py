"""Table IV of the paper: how often an image is still found when its skeleton points are shifted."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import islice

import _paper
import numpy as np
import torch
from _markdown import head_row, interval, paragraph, row
from _paper_cost import enlarged
from _problems import CityDrive, Drive, camvid_problems
from _skeleton_noise import SkeletonPoints
from _trials import Cache

from ssrvlad_torch import SSRVLAD, match
from ssrvlad_torch.datasets.synthetic_city import REFERENCE

SHORTER_SIDE = 1024
CITY_FRAMES = 100
CAMVID_EVERY = 5


@dataclass(frozen=True)
class Variant:
    """The points that are shifted, and the context of the descriptor."""

    name: str
    nodes_only: bool
    context: str = "skeleton"


VARIANTS = (
    Variant("paper, every skeleton pixel", False),
    Variant("paper, keypoints", True),
    Variant("paper with `context` keypoints, keypoints", True, "keypoints"),
)

INTRODUCTION = f"""Each point of the extracted skeleton is shifted at random by up to that many
pixels (+-) in both coordinates; the centres are not shifted. Recall@1 is the fraction of shifted
images whose first candidate is their original. The cells are means of {_paper.REPEATS} repeats,
with minimum and maximum in brackets. The paper shifts "skeleton nodes". It does not say whether
these are all pixels of the skeleton or its keypoints, and gives neither the number nor the size
of its images. Both readings are measured here, on images whose shorter side is {SHORTER_SIDE}
pixels. The preset `default` does not use the skeleton."""


def part(options: argparse.Namespace, results: Cache) -> Iterator[str]:
    """The lines of Table IV."""
    drives = {f"city, {CITY_FRAMES} frames": _city()}
    if options.camvid:
        drive = camvid_problems(options.camvid)[0].searches[0].references
        count = len(range(0, len(drive.places[0]), CAMVID_EVERY))
        drives[f"CamVid labels, {count} frames"] = drive
    yield "## Table IV: noise of the skeleton\n"
    yield paragraph(INTRODUCTION)
    yield from head_row("images", "preset, what is shifted", *(f"+-{p}" for p in _paper.TABLE_IV))
    yield row("the paper's", "not specified", *_paper.TABLE_IV.values())
    for name, drive in drives.items():
        for variant in VARIANTS:
            origin = ("noise", drive.stamp, variant, SHORTER_SIDE, CAMVID_EVERY)
            rates = results.get(origin, partial(recall_rates, drive, variant))
            yield row(name, variant.name, *map(_cell, rates))
    yield ""


def recall_rates(drive: Drive, variant: Variant) -> list[list[float]]:
    """Recall@1 of every repeat, for each shift in the paper."""
    originals = list(_points(drive, variant))
    references = torch.cat([points.descriptors() for points in originals])
    rates = []
    for pixels in _paper.TABLE_IV:
        generator = torch.Generator().manual_seed(pixels)
        rates.append([])
        for _ in range(_paper.REPEATS):
            noisy = [points.shifted(pixels, generator, variant.nodes_only) for points in originals]
            queries = torch.cat([points.descriptors() for points in noisy])
            found = match(queries, references, top=1).indices[:, 0]
            rates[-1].append(float((found == torch.arange(len(found))).double().mean()))
        print(f"{variant.name}, +-{pixels}: {np.mean(rates[-1]):.3f}", flush=True)
    return rates


def _points(drive: Drive, variant: Variant) -> Iterator[SkeletonPoints]:
    every = 1 if isinstance(drive, CityDrive) else CAMVID_EVERY
    for frame in islice(drive, 0, None, every):
        height, width = frame.labels.shape
        scale = SHORTER_SIDE / min(height, width)
        labels = enlarged(frame.labels, (round(height * scale), round(width * scale)), False)
        yield SkeletonPoints.of(_head(variant, frame.labels_as), torch.tensor(labels)[None])


@cache
def _head(variant: Variant, labels_as: str) -> SSRVLAD:
    return SSRVLAD.from_preset("paper", labels_as=labels_as, context=variant.context)


def _city() -> CityDrive:
    return CityDrive(0, REFERENCE, CITY_FRAMES, (SHORTER_SIDE, SHORTER_SIDE))


def _cell(rates: Sequence[float]) -> str:
    return interval(float(np.mean(rates)), (min(rates), max(rates)))
