"""Table III of the paper: the time of every method for a frame of 1024 x 1024."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import _paper
import numpy as np
from _costs import ENCODED, Cost, measure
from _markdown import head_row, largest_mean_smallest, processor, row
from _problems import IMAGES, LABELS, CityDrive, camvid_problems
from _trials import TRAINED, Cache, Rival, with_costs, with_network
from PIL import Image

from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.taxonomy import colourise

SIZE = (1024, 1024)
REFERENCES = 191
ROUNDS, ROUNDS_OF_NETWORKS = 24, 4
PICTURES = 8
EVERY = 26

RIVALS = (
    Rival(_paper.COHOG, "cohog", IMAGES),
    Rival(_paper.REGION_VLAD, "region-vlad", IMAGES),
    Rival(_paper.NETVLAD, "netvlad", IMAGES),
    Rival(_paper.LOST_X, "lost-x", IMAGES),
    Rival.ssrvlad(_paper.SSR_VLAD, "paper", temporal=3),
    Rival.ssrvlad("SSR-VLAD, default", "default", temporal=3),
    Rival("label grid", "label-grid", LABELS),
    Rival("HOG", "hog", IMAGES),
    Rival("tiny image", "tiny-image", IMAGES),
)

INTRODUCTION = f"""Milliseconds for a frame of {SIZE[0]} x {SIZE[1]} pixels, max/average/min.

- Our machine: {{processor}}. The paper's: an i7-10700KF, SSR-VLAD in C++, the others in Python.
- {{frames}} The methods take turns on {ROUNDS} frames ({ROUNDS_OF_NETWORKS} for networks with
  random weights).
- *Extraction* is from the label map to skeletons, keypoints and centres, *encoding* from there to
  the descriptor. A single number is both together.
- *Matching a pair* is the time of one query against {REFERENCES} references (as in RobotCar)
  divided by their number; LoST-X and tiny image have {ENCODED} references.
- The cost of a segmentation network is not included, except in LoST-X, which runs its own; also
  not by the paper.
- In some cells of the paper the maximum is below the minimum; they are as printed.
"""


def part(options: argparse.Namespace, cache: Cache) -> Iterator[str]:
    """The lines of Table III."""
    rivals = with_costs(with_network(RIVALS, options.segmenter))
    origin = ("costs", _stamp(options.camvid), [rival.stamp(options.weights) for rival in rivals])
    found = cache.get(origin, partial(_records, rivals, options))
    costs = {name: Cost(**cost) for name, cost in found.items()}
    frames = (
        "The frames are those of CamVid, enlarged."
        if options.camvid
        else "The frames are those of the synthetic city; its images are coloured label maps."
    )
    yield "## Table III: cost\n"
    yield INTRODUCTION.format(processor=processor(), frames=frames)
    steps = ("extraction", "encoding", "matching a pair")
    yield from head_row("method", *steps, *(f"the paper: {step}" for step in steps))
    for rival in rivals:
        cost = costs[rival.name]
        yield row(shown(rival, cost), *_cells(cost), *_paper.TABLE_III.get(rival.name, ("",) * 3))
    embedded = "SSR-VLAD on a TDA4VM"
    yield row(f"{embedded} (the paper)", "", "", "", *_paper.TABLE_III[embedded])
    yield ""


def _records(rivals: Sequence[Rival], options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    costs = measure_all(rivals, options.camvid, options.weights)
    return {name: asdict(cost) for name, cost in costs.items()}


def shown(rival: Rival, cost: Cost) -> str:
    """The method's name in a table of costs."""
    return f"{rival.name} (random weights)" if "random" in cost.method else rival.name


def measure_all(
    rivals: Sequence[Rival], camvid: Path | None, weights: Path | None
) -> dict[str, Cost]:
    """Costs of rivals by their names; networks without weights get random ones."""
    pictures = {LABELS: [], IMAGES: []}
    for labels, image in islice(_pictures(camvid), PICTURES):
        pictures[LABELS].append(labels)
        pictures[IMAGES].append(image)
    methods = {rival.name: partial(rival.make, weights, True) for rival in rivals}
    frames = {rival.name: pictures[rival.sees] for rival in rivals}
    rounds = {
        rival.name: ROUNDS_OF_NETWORKS if rival.method in TRAINED else ROUNDS for rival in rivals
    }
    return measure(methods, frames, REFERENCES, rounds)


def _pictures(camvid: Path | None) -> Iterator[tuple[Frame, Frame]]:
    """Pairs of label map and image of one frame."""
    if camvid is None:
        for frame in CityDrive(0, REFERENCE, PICTURES, SIZE):
            yield frame, Frame(frame.frame, image=colourise(frame.labels, frame.labels_as))
        return
    drives = {
        p.gives: p.searches[0].queries for p in camvid_problems(camvid) if "esp" not in p.name
    }
    for labels, image in islice(zip(drives[LABELS], drives[IMAGES], strict=True), 0, None, EVERY):
        yield (
            Frame(labels.frame, enlarged(labels.labels, SIZE, False), labels.labels_as),
            Frame(image.frame, image=enlarged(image.image, SIZE, True)),
        )


def enlarged(pixels: np.ndarray, size: tuple[int, int], smooth: bool) -> np.ndarray:
    """A picture or a label map at another size."""
    way = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(pixels).resize(size[::-1], way))


def _stamp(camvid: Path | None) -> str:
    if camvid is None:
        return "the city"
    return " ".join(problem.stamp for problem in camvid_problems(camvid))


def _cells(cost: Cost) -> list[str]:
    pair = [milliseconds / cost.references for milliseconds in cost.match]
    encoding = largest_mean_smallest(cost.aggregate) if any(cost.aggregate or ()) else ""
    return [largest_mean_smallest(cost.extract), encoding, largest_mean_smallest(pair)]
