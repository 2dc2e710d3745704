#!/usr/bin/env python3
"""Writes docs/soft-votes.md: class scores in place of labels, and what says how far to trust them.

    .venv/bin/python scripts/pages/soft_votes.py --data ../shared/data

The folder holds `camvid`, `uofa`, `gardens_walk` and `networks`. The network's scores of every
picture and of its mirror image are kept in `--cache`, 1 MB each.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _halves import rate
from _markdown import head_row, row, write
from fusion import Search, searches
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ssrvlad_torch import SSRVLAD, Segmenter, SoftSSRVLAD, follow, standardise
from ssrvlad_torch.config import SSRVLADConfig
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.recognition.sweep import score

NETWORK, LABELS_AS, KEPT = "espnetv2", "cityscapes-trainids", 4
LONG = "0016E5"
BATCH = 8
VOID, SURE = 255, 0.5

HEAD = f"""# Soft votes

Written by `scripts/pages/soft_votes.py`; no number is typed by hand. Can the class scores of a
network say more than its labels, or how far to trust them, without truth? {NETWORK}, which was
trained elsewhere, on photographs; its scores are kept at a quarter of its input. *Labels* is
`default` on the class of the highest score. *Soft* adds up probabilities over cells in place of
labels, by `SoftSSRVLAD`. A *weight* takes probability from all classes of a pixel. RecallRate@1
of single frames, standardised, on the second half of each route, and the mean over the conditions
on the first half, by which one would choose; then the same, followed online. The city has no
pictures.

*Evened* are the scores of each class less their mean over the picture, in parts of their
deviation. What one would choose by the first halves, soft votes of them, is also the best on the
second half of three of the four routes of UofA and Gardens Point, by far. On CamVid, where the
labels are good, it loses. So it is no preset: it does not gain everywhere, and it takes the class
scores of every picture, which label maps and exact graphs have not. Who has them, and a network
far from home, can do it with `SoftSSRVLAD`, as this script does. Weights by the mirror image or
by entropy gain little, and labels that are void where they are unsure are hardly better than
labels.
"""


class Seen(NamedTuple):
    """``(B, C, h, w)`` class probabilities of pictures, and of their mirror images, turned back."""

    picture: Tensor
    mirror: Tensor
    scores: Tensor

    @property
    def mean(self) -> Tensor:
        """Of both."""
        return (self.picture + self.mirror) / 2


def sure(seen: Seen) -> Tensor:
    """``(B, 1, h, w)``: 1 less the entropy of the probabilities, in parts of the highest."""
    p = seen.picture
    return 1 + (p * p.clamp(min=1e-9).log()).sum(1, keepdim=True) / math.log(p.shape[1])


def agreeing(seen: Seen) -> Tensor:
    """``(B, 1, h, w)``: how much of the probabilities of picture and mirror image is the same."""
    return (seen.picture * seen.mirror).sqrt().sum(1, keepdim=True)


def labels(seen: Seen) -> Tensor:
    return seen.picture.argmax(1)


def of_both(seen: Seen) -> Tensor:
    return seen.mean.argmax(1)


def where(weight: Callable[[Seen], Tensor], seen: Seen) -> Tensor:
    """Labels, void where the weight is below a half."""
    return labels(seen).masked_fill(weight(seen)[:, 0] < SURE, VOID)


def where_equal(seen: Seen) -> Tensor:
    """Labels, void where those of the mirror image are others."""
    return labels(seen).masked_fill(labels(seen) != seen.mirror.argmax(1), VOID)


def soft(seen: Seen) -> Tensor:
    return seen.picture


def soft_of_both(seen: Seen) -> Tensor:
    return seen.mean


def evened(seen: Seen) -> Tensor:
    """Scores of each class less their mean over the picture, in parts of their deviation."""
    deviation, mean = torch.std_mean(seen.scores, (2, 3), keepdim=True)
    return ((seen.scores - mean) / deviation.clamp(min=1e-6)).softmax(1)


def evened_labels(seen: Seen) -> Tensor:
    return evened(seen).argmax(1)


def weighted(weight: Callable[[Seen], Tensor], seen: Seen) -> Tensor:
    parts = weight(seen)
    return seen.picture * parts / parts.amax((1, 2, 3), keepdim=True)


WAYS: dict[str, Callable[[Seen], Tensor]] = {
    "labels": labels,
    "labels of picture and mirror image": of_both,
    "labels where the mirror image has the same": where_equal,
    "labels where the entropy is low": partial(where, sure),
    "labels, scores evened per picture": evened_labels,
    "soft": soft,
    "soft, picture and mirror image": soft_of_both,
    "soft, scores evened per picture": evened,
    "soft, weighted by the mirror image": partial(weighted, agreeing),
    "soft, weighted by entropy": partial(weighted, sure),
}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, required=True)
    arguments.add_argument("--output", type=Path, default=Path("docs/soft-votes.md"))
    arguments.add_argument("--cache", type=Path, default=Path(".cache/soft-votes"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.cache.mkdir(parents=True, exist_ok=True)
    write(options.output, "\n".join(page(options.data, options.cache)) + "\n")


def page(data: Path, kept: Path) -> Iterator[str]:
    chosen = [search for search in searches(data) if is_of_scores(search)]
    names = [search.name.removesuffix(f", {NETWORK}").split(",")[0] for search in chosen]
    yield HEAD
    for title, followed in (("Single frames", False), ("Followed", True)):
        yield f"## {title}\n"
        yield from head_row("votes", *names, "mean", "mean of the first halves")
        for way in WAYS:
            halves = np.array([rates(search, data, kept, way, followed) for search in chosen])
            second, first = halves[:, 1], halves[:, 0].mean()
            yield row(way, *(f"{each:.3f}" for each in (*second, second.mean(), first)))
        yield ""


def is_of_scores(search: Search) -> bool:
    """Whether both traverses are what this network sees; of CamVid one drive is enough."""
    parts = (search.queries, search.references)
    return all(part[1] == f"predicted_{NETWORK}" and LONG not in part[0] for part in parts)


def rates(search: Search, data: Path, kept: Path, way: str, followed: bool) -> tuple[float, float]:
    """RecallRate@1 of the first and of the second half of the queries."""
    here, there = (
        standardise(described(data, kept, folder[0], way)[rows])
        for folder, rows in (
            (search.queries, search.query_rows),
            (search.references, search.reference_rows),
        )
    )
    scores = score(here, there)
    found = follow(scores, [""] * len(there), mode="online").indices[:, 0] if followed else None
    best = (scores.argmax(1) if found is None else found).numpy()
    half = len(best) // 2
    return rate(best[:half], search.truth[:half]), rate(best[half:], search.truth[half:])


@cache
def described(data: Path, kept: Path, folder: str, way: str) -> Tensor:
    """The descriptors of a traverse by one way to vote."""
    config = SSRVLADConfig.from_preset("default", labels_as=LABELS_AS)
    hard, twin, parts = SSRVLAD(config), SoftSSRVLAD(config), []
    for batch in torch.from_numpy(scores_of(data, kept, folder)).split(BATCH):
        picture, mirror = batch.float().unbind(1)
        voted = WAYS[way](Seen(picture.softmax(1), mirror.softmax(1), picture))
        with torch.no_grad():
            parts.append((hard if voted.ndim == 3 else twin)(voted).float())
    return torch.cat(parts)


def scores_of(data: Path, kept: Path, folder: str) -> np.ndarray:
    """``(N, 2, C, h, w)`` float16 class scores of pictures and of their mirror images."""
    file = kept / f"{folder} {NETWORK}.npy".replace("/", " ")
    if not file.exists():
        segmenter = Segmenter.load(data / "networks" / f"{NETWORK}.yaml", LABELS_AS)
        pictures = map(read_image, find_image_files([str(data / folder / "images")]))
        np.save(file, np.stack([seen_by(segmenter, picture) for picture in pictures]))
        print(file, flush=True)
    kept_scores: np.ndarray = np.load(file, mmap_mode="c")
    return kept_scores


@torch.inference_mode()
def seen_by(segmenter: Segmenter, picture: np.ndarray) -> np.ndarray:
    both = torch.from_numpy(np.stack([picture, picture[:, ::-1]]))
    straight, mirrored = avg_pool2d(segmenter.labels.outputs(both), KEPT)
    return torch.stack([straight, mirrored.flip(2)]).half().numpy()


if __name__ == "__main__":
    main()
