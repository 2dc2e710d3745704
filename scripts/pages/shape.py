#!/usr/bin/env python3
"""Writes docs/shape.md: what of a layer's shape carries, and what the skeleton is worth.

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

Written by `scripts/pages/shape.py`; no number is typed by hand. What of a layer's shape says where
a picture was taken: its area, its skeleton, its boundaries?

RecallRate@1 of single frames, the mean over conditions, each with two halves. *Chosen* is the half
on which directions, bins and weights of `default` were chosen. *Other* is the second half of each
real route, the other drive of CamVid, another city. It had no say in these, and was in view when
the 480 numbers were divided between six layers and the boundaries: of that it is no clean test.
*Standardised* is with each traverse's own mean taken off, *followed* the same as a sequence,
online.

{GROUPS_IN_WORDS}"""

READING = """## What it says

- **The skeleton is worth little**: its lengths in place of the boundaries are no better than more
  numbers for the area, but for real routes on the half that was looked at. Added to the preset, 48
  numbers of it bring at most two queries in a hundred. It stays in `paper`, whose idea it is.
- **Boundaries** bring most where networks err: on the real routes, and most of all once a sequence
  is followed. Where only the labels are noisy, as in the city, and on single raw frames of the
  other half, area alone is as good.
- **Beside unlabelled pixels, too**: without the outlines of what moves, half of the gain is lost.
- **The boundaries of each layer by itself** are better on real routes and worse on CamVid.
- **Merging what networks confuse**, and weights by how well neighbouring frames agree, do not gain
  everywhere: ground and sidewalk as one nowhere clearly, buildings and vegetation as one lose, the
  weights gain on the chosen half more than on the other. None of them is in the package.
- **960 numbers** gain a little here and lose a little there: they do not earn twice the memory, and
  are no preset.
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
    """Ways to describe, by name. All have 480 numbers where nothing else is said."""
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
    """Four directions with as many numbers as there are."""
    return steps.described(steps.cells(masks), (0, 114))


if __name__ == "__main__":
    main()
