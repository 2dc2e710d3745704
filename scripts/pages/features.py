#!/usr/bin/env python3
"""Writes the first table of docs/features.md: what each part of the form of features gains.

    .venv/bin/python scripts/pages/features.py --data ../shared/data

The folder holds `uofa`, `gardens_walk`, `cmu_schenley`, `nordland` and `networks`. The means over
cells of all drives are cached in `--cache`: some 25 minutes of the networks at first.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import _small_network
import numpy as np
import torch
from _described import Described
from _markdown import Page, head_row, parser, row
from conditions import NETWORKS, ROUTES, near_rows, pictures_of
from torch import Tensor

from ssrvlad_torch.channels.signs import REACH, moved
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.recognition.comparison import ReferenceRows
from ssrvlad_torch.segmentation.features import noise_means
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.stages import features as stage

OTHERS = {
    "October -> April": ("cmu_schenley/oct2010_c1", "cmu_schenley/apr2011_c1", "pairs_oct_c1.csv"),
    "winter -> summer": ("nordland/winter", "nordland/summer", ""),
}
"""Queries, references, and the table of true matches; of Nordland those of the same number."""


class Levels(NamedTuple):
    """The means ``(N, C, 16, 16)`` of the activations of a drive, the finer first."""

    fine: Tensor
    coarse: Tensor


FORMS = {
    "as it is": (Levels._fields, 128, 0.5),
    "64 signs a cell": (Levels._fields, 64, 0.5),
    "all of the mean around off": (Levels._fields, 128, 1.0),
    "no mean around off": (Levels._fields, 128, 0.0),
    "the finer level alone": (("fine",), 128, 0.5),
    "the coarser level alone": (("coarse",), 128, 0.5),
    "floats, nothing stored as signs": (Levels._fields, 0, 0.5),
}
"""Levels, signs of a cell (0 for floats), and the share of the mean around that is taken off."""


def main() -> None:
    options = parser(__doc__, "features.md", "described").parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    page = Page("features.md", options.output)
    page.table("## What is stored\n", table(described))


def table(described: Described) -> Iterator[str]:
    """A row for each form and network."""
    names = [*ROUTES, *OTHERS]
    off = (f"standardised, {name}" for name in names)
    yield from head_row("form", "network", *names, *off, "mean of the first four, both")
    for form, (levels, signs, share) in FORMS.items():
        for network in (*NETWORKS, _small_network.NAME):
            with patch.object(stage, "SHARE", share):
                found = [rates(described, network, name, levels, signs) for name in names]
            chosen = np.mean(found[: len(ROUTES)])
            figures = [f"{each:.2f}" for each in np.ravel(found, order="F")]
            yield row(form, network, *figures, f"{chosen:.3f}")


def rates(
    described: Described, network: str, name: str, levels: tuple[str, ...], signs: int
) -> tuple[float, float]:
    """RecallRate@1 of the queries of a route by a form of features, raw and with standardised."""
    queries, references, truth = route(described.data, name)
    noise = [getattr(means(described, network, "noise"), level) for level in levels]
    made = stage.Features(*noise)

    def seen(folder: str) -> Tensor:
        given = [getattr(means(described, network, folder), level) for level in levels]
        return made(*given)[..., : signs // 8] if signs else stage.unit_cells(given)

    def rate(off: bool) -> float:
        if signs:
            known = ReferenceRows(there, ["map"] * len(there))
            scores = known.compare(here, off, True).whole()
        else:
            scores = cosines(here, there, off)
        firsts = scores.argmax(1).tolist()
        return float(np.mean([a in b for a, b in zip(firsts, truth, strict=True) if len(b)]))

    here, there = seen(queries), seen(references)
    return rate(False), rate(True)


def cosines(queries: Tensor, references: Tensor, off: bool) -> Tensor:
    """``(Q, R)`` of cells ``(N, C, 16, 16)``, for the best move of each query."""
    if off:
        queries, references = (each - each.mean(0) for each in (queries, references))
    ours, theirs = (each.transpose(1, 3) for each in (queries, references))
    best = torch.full((len(ours), len(theirs)), -1.0)
    for step in range(-REACH, REACH + 1):
        kept = moved(torch.ones_like(theirs[:1]), step)
        of_query, of_row = moved(ours, step).flatten(1), (theirs * kept).flatten(1)
        lengths = of_query.norm(dim=1)[:, None] * of_row.norm(dim=1)
        best = torch.maximum(best, of_query @ of_row.T / lengths)
    return best


def route(data: Path, name: str) -> tuple[str, str, list[np.ndarray]]:
    """Folders of queries and references, and the true matches of each query."""
    queries, references, reach = ROUTES[name] if name in ROUTES else OTHERS[name]
    here, there = (pictures_of(data, folder) for folder in (queries, references))
    if name in ROUTES:
        return queries, references, near_rows(len(here), len(there), reach)
    if reach:
        pairs = np.loadtxt(data / "cmu_schenley" / reach, np.int64, delimiter=",", skiprows=1)
        truth = [np.zeros(0, np.int64)] * len(here)
        for query, reference, tolerance in pairs:
            truth[query] = np.arange(reference - tolerance, reference + tolerance + 1)
        return queries, references, truth
    numbers = np.array([int(file.name) for file in there])
    near = [np.flatnonzero(abs(numbers - int(file.name)) <= 2) for file in here]
    return queries, references, near


def segmenter_of(described: Described, network: str) -> Segmenter:
    """One of the networks that lie there, or the one that is trained here."""
    if network == _small_network.NAME:
        return _small_network.segmenter(described)
    return described.segmenter(network)


def means(described: Described, network: str, folder: str) -> Levels:
    """The means over cells of a drive, or of the noise from which projections come."""

    def run() -> Levels:
        segmenter = segmenter_of(described, network)
        found = segmenter.features
        if folder == "noise":
            return Levels(*noise_means(segmenter.labels, found.names, *found.size))
        parts = []
        with torch.inference_mode():
            for file in pictures_of(described.data, folder):
                picture = torch.from_numpy(read_image(file))[None]
                _, activations = segmenter.labels.run(picture, found.names)
                parts.append([stage.cell_means(each) for each in activations])
        return Levels(*(torch.cat(each) for each in zip(*parts, strict=True)))

    return Levels(*described.kept(f"cells {network} {folder}", lambda: tuple(run())))


if __name__ == "__main__":
    main()
