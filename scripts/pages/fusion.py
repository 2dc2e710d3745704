#!/usr/bin/env python3
"""Writes docs/fusion.md: label maps, features and pictures together.

    .venv/bin/python scripts/pages/fusion.py --data ../shared/data

The folder holds `camvid`, `uofa`, `gardens_walk` and `networks`; descriptors are cached in
`--cache`, see `_described.py`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from _described import (
    ALONE,
    FEATURES,
    FUSED,
    NETWORKS,
    OURS,
    TOGETHER,
    Described,
    camvid_conditions,
    decide,
    real_conditions,
)
from _markdown import DOCS, ROOT, first_table, head_row, parser, quote, row, write

from ssrvlad_torch.recognition.recognise import Steps

MEMBERS = (OURS, FEATURES, "HOG")
SUMMED = (*MEMBERS, *reversed(FUSED))
WAYS = {
    "Picture by picture": (
        ALONE,
        "Each query alone, as in `locate` and `Localiser`: nothing is standardised, because the\n"
        "mean of one frame describes its place, and the weights are 6, 2 and 1.",
    ),
    "Own means off": (
        Steps(follow=None),
        "The mean of each traverse is subtracted, and a method has the more weight, the farther\n"
        "its first candidates are ahead on this traverse. No ground truth is used.",
    ),
    "Followed online": (
        Steps(follow="online"),
        "The same, and followed online ([steps](recognition.md)), as in `query --follow online`.",
    ),
}

HEAD = """# Label maps, features and pictures together

Written by `scripts/pages/fusion.py`. **If you have pictures, keep the default of `encode`**: it
stores the label map, the features of the network and HOG, and recognition fuses all three.

The tables show RecallRate@1 of `default` (label maps), of features (what the encoder of the network
sees, see [features](features.md)), of HOG (pictures), and of their sums:

- The scores of each method are standard deviations from their mean over all references (z-scores).
- Features count six times and HOG twice as much as label maps. Chosen among thirteen triples with
  the figures of all conditions in view, so these tables are no independent test of the weights.
- *Against the best* is *together* minus the best of the three members.
"""

ELSEWHERE = """## Elsewhere

VPR_Tutorial prints RecallRate@1 0.85 for HDC-DELF (4096 numbers of a network trained for places),
each frame alone, on all 200 frames of the Gardens Point walk: night_right among day_right. The
conditions *night -> right* above are the first 100 frames of both.
"""


def main() -> None:
    options = parser(__doc__, "fusion.md", "described").parse_args()
    torch.set_num_threads(1)
    text = "\n".join(page(Described(options.data, options.cache))) + "\n"
    write(options.output, text)
    if options.output.resolve().parent == DOCS:
        quote(ROOT / "README.md", "fusion", excerpt(text))


def page(described: Described) -> Iterator[str]:
    yield HEAD
    every = (*real_conditions(described, NETWORKS), *camvid_conditions(described))
    conditions = [condition for condition in every if condition.suits(FEATURES)]
    for title, (steps, about) in WAYS.items():
        yield f"## {title}\n\n{about}\n"
        yield from head_row("condition", *SUMMED, "against the best")
        rates = np.array(
            [
                [decide(described, condition, method, steps).right.mean() for method in SUMMED]
                for condition in conditions
            ]
        )
        ahead = rates[:, -1] - rates[:, : len(MEMBERS)].max(axis=1)
        names = [*(f"{each.dataset}, {each.name}" for each in conditions), "mean"]
        for name, *figures, best in zip(
            names,
            *np.vstack([rates, rates.mean(axis=0)]).T,
            [*ahead, ahead.mean()],
            strict=True,
        ):
            yield row(name, *(f"{figure:.3f}" for figure in figures), f"{best:+.3f}")
        yield ""
    yield ELSEWHERE


def excerpt(page: str) -> str:
    """The means of single pictures, for README.md."""
    names, *_, means = first_table(page, "## Picture by picture")
    found = dict(zip(names, means, strict=True))
    return (
        f"`default` alone {found[OURS]}, HOG {found['HOG']},\n  features {found[FEATURES]}, "
        f"all three {found[TOGETHER]}"
    )


if __name__ == "__main__":
    main()
