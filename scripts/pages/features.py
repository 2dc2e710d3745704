#!/usr/bin/env python3
"""Writes docs/features.md: how features are stored.

    .venv/bin/python scripts/pages/features.py --data ../shared/data

The folder holds `uofa`, `gardens_walk` and `networks`, as for `_described.py`. The activations of
both networks are averaged in 24 x 32 cells and cached in `--cache`, 1 GB: 20 minutes on one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from _described import LAST, Described
from _markdown import Page, head_row, parser, row
from conditions import NETWORKS, ROUTES, kept, real
from torch import Tensor

FINE = (24, 32)
GRID = (12, 16)
SIDES = (-2, -1, 0, 1, 2)
HALVES = ("first", "second")

Activations = Callable[[str, str], Tensor]


def main() -> None:
    options = parser(__doc__, "features.md", "activations").parse_args()
    torch.set_num_threads(1)
    page = Page("features.md", options.output)
    page.table("## What is stored\n", table(partial(pooled, options.data, options.cache)))


def table(known: Callable[[str, str, str], Tensor]) -> Iterator[str]:
    """The rates of every form."""
    ways = ("raw", "own means off")
    names = [f"{way}, {name}" for way, name in product(ways, (*ROUTES, *HALVES))]
    yield from head_row("form", "network", *names)
    yield from lines("floats, 12 x 16", partial(cells, known, "fine"))
    yield from lines("floats, 12 x 16, last of the encoder", partial(cells, known, "last"))
    for (rows, columns), bits in (((16, 16), 64), ((12, 16), 85), ((8, 16), 128), ((6, 8), 341)):
        form = f"{rows} x {columns} cells, {bits} signs"
        yield from lines(form, signs(known, (rows, columns), bits, True))
    yield from lines("12 x 16 cells, 42 signs", signs(known, GRID, 42, True))
    for draw in range(3):
        shared = signs(known, GRID, 85, False, draw)
        yield from lines("12 x 16 cells, 85 signs, shared projections", shared)


def lines(name: str, activations: Activations) -> Iterator[str]:
    """The rates of all conditions by each network."""
    for network in NETWORKS:
        rates = []
        for standardised in (False, True):
            found = [
                rates_of(activations, network, *route, standardised) for route in ROUTES.values()
            ]
            whole, *halves = zip(*found, strict=True)
            rates += [f"{rate:.2f}" for rate in whole] + [f"{np.mean(h):.3f}" for h in halves]
        yield row(name, network, *rates)
        print(name, network, flush=True)


def rates_of(
    activations: Activations,
    network: str,
    queries: str,
    references: str,
    reach: int,
    standardised: bool,
) -> list[float]:
    """RecallRate@1 of whole traverses, of their first and of their second halves."""
    here, there = activations(network, queries), activations(network, references)
    middle, rates = len(here) // 2, []
    for part in (slice(None), slice(None, middle), slice(middle, None)):
        q, r = (own_mean_off(x[part]) if standardised else x[part] for x in (here, there))
        rows = best_move(q, r).argmax(1)
        rates.append(float(((rows - torch.arange(len(q))).abs() <= reach).float().mean()))
    return rates


def own_mean_off(grids: Tensor) -> Tensor:
    return grids - grids.mean(0)


@cache
def pooled(data: Path, folder: Path, network: str, which: str, drive: str) -> Tensor:
    """``(N, C, 24, 32)`` of the ``fine`` activation of the rule, or the ``last`` of the encoder."""

    def make() -> Tensor:
        last = LAST[network] if which == "last" else None
        segmenter = Described(data, folder).segmenter(network, last)
        names, found = segmenter.features.names, []
        for frame in real(data / drive, network).seen():
            picture = torch.from_numpy(frame.image)[None]
            with torch.inference_mode():
                _, [activation] = segmenter.labels.run(picture, names)
            found.append(F.adaptive_avg_pool2d(activation, FINE).half())
        return torch.cat(found)

    return kept(folder / f"{network} {drive.replace('/', ' ')} {which}.pt", make)


def cells(
    known: Callable[[str, str, str], Tensor],
    which: str,
    network: str,
    drive: str,
    grid: tuple[int, int] = GRID,
) -> Tensor:
    """``(N, C, rows, columns)``, cells of length 1."""
    grids = F.adaptive_avg_pool2d(known(network, which, drive).float(), grid)
    return F.normalize(instance_norm(grids), dim=1)


def instance_norm(grids: Tensor) -> Tensor:
    centred = grids - grids.mean((2, 3), keepdim=True)
    return centred / centred.square().mean((2, 3), keepdim=True).sqrt().clamp(min=1e-6)


def signs(
    known: Callable[[str, str, str], Tensor],
    grid: tuple[int, int],
    bits: int,
    by_row: bool,
    seed: int = 0,
) -> Activations:
    """Signs of random projections, of each row its own or of all the same."""

    def of(network: str, drive: str) -> Tensor:
        grids = cells(known, "fine", network, drive, grid)
        random = torch.Generator().manual_seed(seed)
        shape = (grid[0] if by_row else 1, bits, grids.shape[1])
        chosen = torch.randint(0, 2, shape, generator=random).float() * 2 - 1
        projected = torch.einsum("nchw,hbc->nbhw", grids, chosen.expand(grid[0], -1, -1))
        return torch.where(projected > 0, 1.0, -1.0)

    return of


def best_move(queries: Tensor, references: Tensor) -> Tensor:
    """``(Q, R)`` cosines over the cells that overlap, for the best move."""
    steps = max(1, queries.shape[3] // GRID[1])
    found = []
    for move in SIDES:
        here, there = (
            overlap(each, sign * move * steps).flatten(1)
            for each, sign in ((queries, 1), (references, -1))
        )
        found.append(F.normalize(here) @ F.normalize(there).T)
    return torch.stack(found).amax(0)


def overlap(grids: Tensor, move: int) -> Tensor:
    return grids.narrow(3, max(0, move), grids.shape[3] - abs(move))


if __name__ == "__main__":
    main()
