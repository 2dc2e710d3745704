"""Table III of the paper: the time of every method for a frame of 1024 x 1024."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import islice

import _paper
import numpy as np
from _costs import ENCODED, Cost
from _described import Described
from _markdown import head_row, largest_mean_smallest, processor, row
from _trials import camvid_trials, costs, shown
from conditions import city
from PIL import Image

from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.taxonomy import colourise

SIZE = (1024, 1024)
REFERENCES = 191
ROUNDS, ROUNDS_OF_NETWORKS = 24, 4
PICTURES = 8
EVERY = 26

METHODS = (
    *(_paper.COHOG, _paper.REGION_VLAD, _paper.NETVLAD, _paper.LOST_X, _paper.SSR_VLAD),
    *("SSR-VLAD, default", "label grid", "HOG", "tiny image"),
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


def part(options: argparse.Namespace, described: Described) -> Iterator[str]:
    """The lines of Table III."""
    pictures = list(islice(_pictures(options, described), PICTURES))
    found = costs(described, METHODS, pictures, REFERENCES, (ROUNDS, ROUNDS_OF_NETWORKS))
    frames = (
        "The frames are those of CamVid, enlarged."
        if options.camvid
        else "The frames are those of the synthetic city; its images are coloured label maps."
    )
    yield "## Table III: cost\n"
    yield INTRODUCTION.format(processor=processor(), frames=frames)
    steps = ("extraction", "encoding", "matching a pair")
    yield from head_row("method", *steps, *(f"the paper: {step}" for step in steps))
    for name, cost in found.items():
        yield row(shown(name, cost), *_cells(cost), *_paper.TABLE_III.get(name, ("",) * 3))
    embedded = "SSR-VLAD on a TDA4VM"
    yield row(f"{embedded} (the paper)", "", "", "", *_paper.TABLE_III[embedded])
    yield ""


def _pictures(options: argparse.Namespace, described: Described) -> Iterator[Frame]:
    """Label map and image of frames."""
    if options.camvid is None:
        for frame in city(0, REFERENCE, PICTURES, SIZE).seen():
            image = colourise(frame.labels, frame.labels_as)
            yield Frame(frame.frame, frame.labels, frame.labels_as, image)
        return
    [search] = camvid_trials(described, options.camvid)[0].searches
    for frame in described.drive(search.queries).seen(search.query_rows[::EVERY]):
        labels, image = enlarged(frame.labels, SIZE, False), enlarged(frame.image, SIZE, True)
        yield Frame(frame.frame, labels, frame.labels_as, image)


def enlarged(pixels: np.ndarray, size: tuple[int, int], smooth: bool) -> np.ndarray:
    """A picture or a label map at another size."""
    way = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(pixels).resize(size[::-1], way))


def _cells(cost: Cost) -> list[str]:
    pair = [milliseconds / cost.references for milliseconds in cost.match]
    encoding = largest_mean_smallest(cost.aggregate) if any(cost.aggregate or ()) else ""
    return [largest_mean_smallest(cost.extract), encoding, largest_mean_smallest(pair)]
