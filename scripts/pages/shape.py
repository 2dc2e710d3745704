#!/usr/bin/env python3
"""Writes docs/shape.md: descriptors of area, skeleton and boundaries, compared.

    .venv/bin/python scripts/pages/shape.py --data ../shared/data

The folder holds `camvid`, `uofa` and `gardens_walk`. Every condition has two halves.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import steps
import torch
from _halves import GROUPS, GROUPS_IN_WORDS, HALVES, WAYS, measured
from _markdown import head_row, row, write
from conditions import (
    Describe,
    Masks,
    described_by,
    described_by_baseline,
    described_from_masks,
)
from torch import Tensor

from ssrvlad_torch.config import SSRVLADConfig

HEAD = f"""# Shape

Written by `scripts/pages/shape.py`. Which part of a layer's shape says where a picture was taken:
its area, its skeleton or its boundaries? The numbers are RecallRate@1, the mean over the
conditions of a group:

{GROUPS_IN_WORDS}
Each condition has two halves:

- *chosen*: the half on which directions, bins and weights of `default` were chosen.
- *other*: the second half of each real route, the other drive of CamVid, another city. It was not
  used for these choices. It was known when the 480 numbers were divided between six layers and the
  boundaries, so it is no independent test of that division.

There are three tables: *raw* single frames; *standardised* single frames, after the mean of each
traverse is subtracted; and *followed*, the standardised frames found as a sequence, online (from
the queries so far).
"""

READING = """## Conclusions

- **Skeletons gain little.** In place of the boundaries (*area and skeleton*) they are no better
  than more numbers for the area (*area alone*), except on the real routes, mostly on the chosen
  half. Added to the preset with 48 more numbers, they gain at most two queries in a hundred. They
  stay in `paper`.
- **Boundaries gain most where networks make errors**: on the real routes, and there most of all
  when a sequence is followed. In the city, where the labels have only noise, and on raw frames of
  the other half, area alone is as good.
- **Boundaries to unlabelled pixels help too.** Without the outlines of moving objects (*boundaries
  between labelled pixels*), half of the gain is lost.
- **Separate boundaries for each layer** are better on real routes and worse on CamVid.
- **Merged classes** and **weights by agreement** (of neighbouring frames) are not in the package.
  Ground and sidewalk as one gain nothing clear, buildings and vegetation as one lose, and the
  weights gain more on the chosen half than on the other.
- **960 numbers** gain a little in some columns and lose a little in others. That is not worth
  twice the memory.
"""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, required=True)
    arguments.add_argument("--output", type=Path, default=Path("docs/shape.md"))
    arguments.add_argument("--cache", type=Path, default=Path(".cache/shape"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    found = measured(ways(), options.data, options.cache)
    write(options.output, "\n".join(page(found)) + "\n")


def page(rates: dict[str, dict[str, list[float]]]) -> Iterator[str]:
    yield HEAD
    for number, title in enumerate(WAYS):
        yield f"## {title.capitalize()}\n"
        yield from head_row("", *(f"{group}, {half}" for group in GROUPS for half in HALVES))
        for name, found in rates.items():
            own = [found[f"{group}, {half}"][number] for group in GROUPS for half in HALVES]
            yield row(name, *(f"{rate:.3f}" for rate in own))
        yield ""
    yield READING


def ways() -> dict[str, Describe]:
    """Ways to describe, by name. All have 480 numbers unless the name says otherwise."""
    default = SSRVLADConfig()
    return {
        "default": described_by(default),
        "label grid": described_by_baseline("label-grid"),
        "area alone": described_from_masks(steps.area_alone),
        "area and skeleton": described_from_masks(steps.skeleton_in_place_of_boundaries),
        "area, boundaries and skeleton (528)": described_from_masks(steps.skeleton_lengths_too),
        "boundaries of each layer": described_from_masks(boundaries_of_each_layer),
        "boundaries between labelled pixels": described_from_masks(steps.between_labelled_pixels),
        "boundaries alone (4 x 114)": described_from_masks(boundaries_alone),
        "ground and sidewalk as one": described_from_masks(partial(steps.with_merged, 0, 1)),
        "buildings and vegetation as one": described_from_masks(partial(steps.with_merged, 2, 4)),
        "weighted by agreement": steps.weighted_by_agreement(described_by(default)),
        "960 numbers": steps.harmonics(SSRVLADConfig(harmonics=108, boundary_harmonics=78)),
    }


def boundaries_of_each_layer(masks: Masks) -> Tensor:
    """Area with 40 numbers, the directions of each layer's own boundary with 10 each."""
    return steps.with_boundaries_of_each_layer(masks, 40, 10)


def boundaries_alone(masks: Masks) -> Tensor:
    """Four directions with all their numbers."""
    return steps.described(steps.cells(masks), (0, 114))


if __name__ == "__main__":
    main()
