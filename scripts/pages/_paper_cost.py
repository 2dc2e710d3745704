"""Table III of the paper: the time of every method for a frame of 1024 x 1024."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping

import _paper
import numpy as np
from _costs import Cost
from _described import Described
from _markdown import Page, head_row, largest_mean_smallest, processor, row
from _trials import camvid_trials, costs, shown
from PIL import Image

from ssrvlad_torch.channels.channel import View

SIZE = (1024, 1024)
REFERENCES = 191
ROUNDS, ROUNDS_OF_NETWORKS = 24, 4
PICTURES = 8
EVERY = 26

METHODS = (
    *(_paper.COHOG, _paper.REGION_VLAD, _paper.NETVLAD, _paper.LOST_X, _paper.SSR_VLAD),
    *("SSR-VLAD, default", "label grid", "HOG", "tiny image"),
)


def part(page: Page, options: argparse.Namespace, described: Described) -> None:
    """Table III, of CamVid."""
    if options.camvid is None:
        print("Table III: no --camvid")
        return
    [search] = camvid_trials(described, options.camvid)[0].searches
    rows = search.query_rows[: EVERY * PICTURES : EVERY]
    pictures = [
        View(
            frame.frame,
            enlarged(frame.labels, Image.Resampling.NEAREST),
            frame.labels_as,
            enlarged(frame.picture, Image.Resampling.BILINEAR),
        )
        for frame in described.drive(search.queries).seen(rows)
    ]
    found = costs(described, METHODS, pictures, REFERENCES, (ROUNDS, ROUNDS_OF_NETWORKS))
    page.paragraph("- Our machine:", f"- Our machine: {processor()}.", " The paper's:")
    page.table("## Table III: cost\n", table(found))


def enlarged(pixels: np.ndarray, way: Image.Resampling) -> np.ndarray:
    return np.asarray(Image.fromarray(pixels).resize(SIZE[::-1], way))


def table(found: Mapping[str, Cost]) -> Iterator[str]:
    """A row for each method, ours beside the paper's."""
    steps = ("extraction", "encoding", "matching a pair")
    yield from head_row("method", *steps, *(f"the paper: {step}" for step in steps))
    for name, cost in found.items():
        yield row(shown(name, cost), *_cells(cost), *_paper.TABLE_III.get(name, ("",) * 3))
    embedded = "SSR-VLAD on a TDA4VM"
    yield row(f"{embedded} (the paper)", "", "", "", *_paper.TABLE_III[embedded])


def _cells(cost: Cost) -> list[str]:
    pair = [milliseconds / cost.references for milliseconds in cost.match]
    encoding = largest_mean_smallest(cost.aggregate) if any(cost.aggregate) else ""
    return [largest_mean_smallest(cost.extract), encoding, largest_mean_smallest(pair)]
