#!/usr/bin/env python3
"""Writes a section of docs/fusion.md: what other weights would find.

.venv/bin/python scripts/pages/fusion_weights.py --data ../shared/data
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import NamedTuple

import _small_network
import numpy as np
import torch
from _described import FEATURES, OURS, Described, channel_of, swept
from _markdown import Page, head_row, parser, row
from _sure_cases import add_new, of_third_network, pairs, vectors
from conditions import NETWORKS, ROUTES, pictured, pictures_of

from ssrvlad_torch.recognition.fusion import Scale, z_lead
from ssrvlad_torch.recognition.sweep import COLUMNS

TRUSTS = [
    (f, h, s)
    for f, h, s in product((0, 1, 2, 3, 4, 6, 8, 12, 16), (0, 0.5, 1, 2, 3, 4, 6), (0, 1))
    if f + h + s
]
TODAY, MEMBERS = (6, 2, 1), (FEATURES, "HOG", OURS)
CHOOSING = [route[:2] for route in ROUTES.values()]
LEADS = {"trust alone": 0.0, "times the root of the query's own lead": 0.5, "times its lead": 1.0}


class Found(NamedTuple):
    """For each of `TRUSTS` and each query, whether the first answer is right, by a way."""

    network: str
    pair: str
    way: str
    right: np.ndarray


def main() -> None:
    options = parser(__doc__, "fusion.md", "described").parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    found = described.kept("fusion weights", lambda: [tuple(each) for each in all_found(described)])
    Page("fusion.md", options.output, False).table("## Other weights\n", table([Found(*f) for f in found]))


def all_found(described: Described) -> Iterator[Found]:
    add_new(described)
    list(of_third_network(described))
    add_maps(described)
    for network in (*NETWORKS, _small_network.NAME):
        for name, here, there, truth in pairs(described, network):
            raw, leads, z_off, leads_off = zs(described, here, there)
            known = [np.isin(np.arange(len(there)), rows) for rows in truth]
            truths = torch.from_numpy(np.stack(known))
            some = truths.any(1)
            for way, power in LEADS.items():
                weights = leads.clamp(min=0) ** power
                weights = weights.where(weights.sum(0, keepdim=True) > 0, torch.ones(1))
                yield Found(network, name, way, rights(raw * weights[..., None], truths)[:, some])
            right = rights(z_off * leads_off.clamp(min=0)[:, None, None], truths)[:, some]
            yield Found(network, name, "standardised", right)
            print(network, name, flush=True)


def rights(z: torch.Tensor, truths: torch.Tensor) -> np.ndarray:
    best = [torch.tensordot(torch.tensor(t, dtype=z.dtype), z, 1).argmax(1) for t in TRUSTS]
    return np.stack([truths.gather(1, each[:, None])[:, 0].numpy() for each in best])


def zs(described, here, there):
    out = []
    for off in (False, True):
        z, lead = [], []
        for method in MEMBERS:
            queries, rows = (vectors(described, frames, method) for frames in (here, there))
            if rows.ndim == 3:
                rows = rows[:, COLUMNS.index(0)]
            known = channel_of(method).references(rows, ["map"] * len(rows))
            if off:
                scores = known.compare(queries, True, True).whole()
            else:
                each = [known.compare(one[None], False, True).whole()[0] for one in queries]
                scores = torch.stack(each)
            z.append(Scale.of(scores).z(scores))
            lead.append(torch.tensor([z_lead(one) for one in scores]))
        leads = torch.stack(lead)
        out += [torch.stack(z), leads.mean(1) if off else leads]
    return out


def add_maps(described: Described) -> None:
    """The label maps and HOG of the third network's drives."""
    segmenter = _small_network.segmenter(described)
    for name in list(described.added):
        if _small_network.NAME in name:
            folder = name.removeprefix(f"real {_small_network.NAME} ")
            files = pictures_of(described.data, folder)
            labels = partial(pictured, files, segmenter)
            described.kept(f"{name} {version()}", lambda labels=labels: swept(labels(), OURS))


def version() -> str:
    from _described import head

    return f"{OURS} {head(OURS, 'camvid-11').config.fingerprint}"


SHOWN = {
    "6, 2, 1, as it is": TODAY, "4, 2, 1": (4, 2, 1), "3, 2, 1": (3, 2, 1), "1, 1, 1": (1, 1, 1),
    "6, 2, 0": (6, 2, 0), "6, 0, 1": (6, 0, 1), "features alone": (1, 0, 0),
    "HOG alone": (0, 1, 0), "label maps alone": (0, 0, 1),
}  # fmt: skip
NAMES = {"trust alone": "alone", "times its lead": "alone, times the query's own lead"}


def table(found: list[Found]) -> Iterator[str]:
    """A row for each way and weights: RecallRate@1 of the first halves and of the others."""
    every = (*NETWORKS, _small_network.NAME)
    yield from head_row(
        "queries", "weights", *(f"{network}, {part}" for network in every for part in PARTS)
    )
    for way in ("trust alone", "times its lead", "standardised"):
        means = {(n, part): mean(found, n, way, part) for n in every for part in PARTS}
        best = int(np.mean([means[n, PARTS[0]] for n in NETWORKS], 0).argmax())
        chosen = ", ".join(f"{weight:g}" for weight in TRUSTS[best])
        for name, weights in {**SHOWN, f"{chosen}, best by first halves": TRUSTS[best]}.items():
            at = TRUSTS.index(weights)
            yield row(NAMES.get(way, way), name, *(f"{each[at]:.3f}" for each in means.values()))


PARTS = "first halves", "check"


def mean(found: list[Found], network: str, way: str, part: str) -> np.ndarray:
    """For each of `TRUSTS` the mean rate of pairs: the first halves of the queries of the four
    routes, both ways; or the second halves, and the other places whole."""
    rates = []
    for each in found:
        if (each.network, each.way) != (network, way):
            continue
        half, routes = each.right.shape[1] // 2, any(f in each.pair for f in ("uofa", "gardens"))
        if part == PARTS[0] and routes:
            rates.append(each.right[:, :half].mean(1))
        elif part == PARTS[1]:
            rates.append(each.right[:, half if routes else 0 :].mean(1))
    return np.mean(rates, 0)


if __name__ == "__main__":
    main()
