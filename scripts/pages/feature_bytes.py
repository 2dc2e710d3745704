#!/usr/bin/env python3
"""Writes the tables of "What each byte gains" in docs/features.md: other ways to store the cells.

    .venv/bin/python scripts/pages/feature_bytes.py --data ../shared/data

Data and cache are those of `features.py`, and `vprbench/corridor`. An hour on one thread.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from unittest.mock import patch

import features
import numpy as np
import torch
from _cell_forms import Form, Source, scores
from _described import Described
from _markdown import Page, head_row, parser, row
from _small_network import NAME
from conditions import NETWORKS, RESAMPLES, ROUTES, near_rows, pictures_of
from torch import Tensor

SEEDS, BLOCK = 5, 10
JULY = {"July -> April": ("cmu_schenley/jul2011_c1", "cmu_schenley/apr2011_c1", "pairs_jul_c1.csv")}
CORRIDOR = ("vprbench/corridor/query", "vprbench/corridor/ref", near_rows(111, 111, 2))
CONDITIONS = (*ROUTES, *features.OTHERS, *JULY, "corridor")
AS_IT_IS = "128 signs, as it is"
FORMS = {
    "16 signs": Form(16),
    "32 signs": Form(32),
    "8 rows, 8 columns, 128 signs": Form(pool=(2, 2)),
    "64 signs": Form(64),
    "32 of two bits, quarters of a normal": Form(32, cut="normal"),
    "8 rows, 128 signs": Form(pool=(2, 1)),
    AS_IT_IS: Form(),
    "128 signs of 32 components": Form(components=32),
    "128 signs of 64 components": Form(components=64),
    "128 signs of 256 components": Form(components=256),
    "64 of two bits, quarters of a normal": Form(64, cut="normal"),
    "64 of two bits, quarters of the map": Form(64, cut="map"),
    "64 of two bits of 64 components": Form(64, 64, cut="normal"),
    "components of the map, equal variances": Form(of="map"),
    "components of the map, own variances": Form(of="map", equal=False),
    "the same, rotated by ITQ": Form(of="map", equal=False, turns=20),
    "orthogonal projections, no components": Form(of=""),
    "cells weighed by their spread": Form(weighed=True),
    "8 rows, 256 signs": Form(256, 256, pool=(2, 1)),
    "8 columns, 256 signs": Form(256, 256, pool=(1, 2)),
    "256 signs": Form(256, 256),
    "128 of two bits, quarters of a normal": Form(cut="normal"),
    "128 of two bits, quarters of the map": Form(cut="map"),
    "floats": Form(0, of=""),
}
Hits = list[Tensor]


def main() -> None:
    options = parser(__doc__, "features.md", "described").parse_args()
    torch.set_num_threads(1)
    described, hits = Described(options.data, options.cache), {}
    for network in (*NETWORKS, NAME):
        source = Source(described, network)
        for name, form in FORMS.items():
            key = f"bytes {network} {name}"
            hits[network, name] = described.kept(key, partial(all_hits, source, form))
    page = Page("features.md", options.output, whole=False)
    page.table("## What each byte gains\n", gains(hits))
    page.table("By condition:\n", by_condition(hits))


def gains(hits: dict[tuple[str, str], Hits]) -> Iterator[str]:
    """A row for each form, with its difference from today's on the check."""
    each = [f"{n}, {part}" for n in (*NETWORKS, NAME) for part in ("first halves", "check", "gain")]
    yield from head_row("form", "bytes", *each)
    variances = []
    for name, form in FORMS.items():
        figures, of_draws = [], []
        for network in (*NETWORKS, NAME):
            (*both, check), (*_, base) = (parts(hits[network, key]) for key in (name, AS_IT_IS))
            rates = [torch.stack([x.nanmean((1, 2)) for x in y]).mean(0) for y in (*both, check)]
            figures += [f"{rate.mean():.3f}" for rate in rates]
            figures.append("" if name == AS_IT_IS else difference(check, base))
            of_draws += [*rates, torch.full((SEEDS,), np.nan)]
        variances += [[float(rate.var()) for rate in of_draws]] if form.signs else []
        yield row(name, str(form.size) if form.signs else "", *figures)
    deviations = np.sqrt(np.mean(variances, 0))
    yield row("deviation of one draw", "", *("" if np.isnan(x) else f"{x:.3f}" for x in deviations))


def parts(hits: Hits) -> tuple[Hits, Hits]:
    """Hits ``(seeds, 2, Q)`` in the first halves of routes, and those of the check."""
    routes = 2 * len(ROUTES)
    first, second = zip(*(each[:, :, 1].chunk(2, 2) for each in hits[:routes]), strict=True)
    return list(first), [*second, *(each[:, :, 0] for each in hits[routes:])]


def difference(ours: Hits, base: Hits) -> str:
    """The mean difference over conditions, and 95 % of those with queries drawn anew, in blocks of
    neighbours; both directions of a condition are drawn alike."""
    rng, exact, drawn = np.random.default_rng(0), [], []
    shares = rng.random((len(ours) // 2, RESAMPLES, 200))
    for number, pair in enumerate(zip(ours, base, strict=True)):
        gained = np.subtract(*(each.mean((0, 1)).numpy() for each in pair))
        gained = gained[~np.isnan(gained)]
        starts = (shares[number // 2, :, : -(-len(gained) // BLOCK)] * len(gained)).astype(int)
        chosen = gained[(starts[..., None] + np.arange(BLOCK)) % len(gained)]
        exact.append(gained.mean())
        drawn.append(chosen.mean((1, 2)))
    low, high = np.quantile(np.mean(drawn, 0), (0.025, 0.975))
    return f"{np.mean(exact):+.3f} [{low:+.3f}, {high:+.3f}]"


def by_condition(hits: dict[tuple[str, str], Hits]) -> Iterator[str]:
    """A row for each form and network."""
    off = (f"standardised, {name}" for name in CONDITIONS)
    yield from head_row("form", "network", *CONDITIONS, *off)
    for name in FORMS:
        for network in (*NETWORKS, NAME):
            forth = [each[:, :, 0].nanmean((0, 2)) for each in hits[network, name][::2]]
            yield row(name, network, *(f"{x:.2f}" for x in torch.stack(forth).T.flatten()))


def all_hits(source: Source, form: Form) -> Hits:
    """`judged` of all seeds, for each condition and its opposite direction."""
    found = []
    for name in CONDITIONS:
        here, there, right = condition(source.described.data, name)
        seeds = range(SEEDS if form.signs else 1)
        forth = [scores(source, form, here, there, seed) for seed in seeds]
        back = [each.transpose(1, 2) for each in forth]
        if form.needs_map:
            back = [scores(source, form, there, here, seed) for seed in seeds]
        for found_by, truth in ((forth, right), (back, right.T)):
            found.append(torch.stack([judged(each, truth) for each in found_by]))
    return found


def condition(data: Path | None, name: str) -> tuple[str, str, Tensor]:
    """Folders of queries and of references, and which of these ``(Q, R)`` are right."""
    assert data
    with patch.dict(features.OTHERS, JULY):
        here, there, truth = CORRIDOR if name == "corridor" else features.route(data, name)
    right = torch.zeros(len(truth), len(pictures_of(data, there)), dtype=torch.bool)
    for query, rows in enumerate(truth):
        right[query, rows] = True
    return here, there, right


def judged(found: Tensor, right: Tensor) -> Tensor:
    """``(2 ways, 2, Q)``: whether the first candidate is right in the whole map, and in the half of
    it that is the query's; NaN where none is."""
    ours, theirs = (torch.arange(count) * 2 >= count for count in right.shape)
    hits = []
    for searched in (torch.ones_like(right), ours[:, None] == theirs):
        firsts = found.masked_fill(~searched, -torch.inf).argmax(2)
        hit = right.expand(2, -1, -1).gather(2, firsts[..., None])[..., 0].float()
        hits.append(hit.masked_fill(~(right & searched).any(1), torch.nan))
    return torch.stack(hits, 1)


if __name__ == "__main__":
    main()
