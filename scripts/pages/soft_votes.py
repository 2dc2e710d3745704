#!/usr/bin/env python3
"""Writes docs/soft-votes.md: class scores in place of labels, with weights of pixels.

    .venv/bin/python scripts/pages/soft_votes.py --data ../shared/data

The folder holds `camvid`, `uofa`, `gardens_walk` and `networks`. The network's scores of every
picture and of its mirror image are cached in `--cache`, 1 MB each.
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

NETWORK, LABELS_AS, STRIDE = "espnetv2", "cityscapes-trainids", 4
LONG = "0016E5"
BATCH = 8
VOID, SURE = 255, 0.5

HEAD = f"""# Soft votes

Written by `scripts/pages/soft_votes.py`. Are the class scores of a network better than its labels?
Can they show, without ground truth, which pixels to trust? **Not everywhere**:

- *Soft, scores evened per picture* is clearly the best single-frame variant on three of the four
  routes of UofA and Gardens Point, where the network is poor, and on the first halves. On CamVid,
  where the labels are good, it is worse than labels.
- The other variants gain little.
- None is in the package: none gains everywhere, and label maps and exported graphs have no class
  scores. With class scores, `SoftSSRVLAD` computes soft votes as this script does.

The network is {NETWORK}, trained on other data. Its scores are stored at a quarter of its input
size. The city has no pictures and is not measured.

- *labels*: `default` on the class with the highest score.
- *labels where*: labels are void where the condition does not hold.
- *soft*: probabilities are summed over cells in place of labels, by `SoftSSRVLAD`.
- *picture and mirror image*: the mean of the probabilities of both.
- *evened*: the scores of each class minus their mean over the picture, divided by their standard
  deviation.
- *weighted*: the probabilities of a pixel times a weight: the agreement with the mirror image, or
  one minus the entropy as a fraction of the highest entropy.

The tables show RecallRate@1, standardised, on the second half of each route, their mean, and the
mean over the first halves, which one would use to choose a variant. *Followed* is online.
"""


class Seen(NamedTuple):
    """``(B, C, h, w)`` class probabilities of pictures and of their mirror images (mirrored back),
    and class scores of pictures."""

    picture: Tensor
    mirror: Tensor
    scores: Tensor

    @property
    def mean(self) -> Tensor:
        """Mean probabilities of picture and mirror image."""
        return (self.picture + self.mirror) / 2


def sure(seen: Seen) -> Tensor:
    """``(B, 1, h, w)``: 1 minus the entropy, as a fraction of the highest entropy."""
    p = seen.picture
    return 1 + (p * p.clamp(min=1e-9).log()).sum(1, keepdim=True) / math.log(p.shape[1])


def agreeing(seen: Seen) -> Tensor:
    """``(B, 1, h, w)``: agreement of the probabilities of picture and mirror image, 0 to 1."""
    return (seen.picture * seen.mirror).sqrt().sum(1, keepdim=True)


def labels(seen: Seen) -> Tensor:
    return seen.picture.argmax(1)


def of_both(seen: Seen) -> Tensor:
    return seen.mean.argmax(1)


def where(weight: Callable[[Seen], Tensor], seen: Seen) -> Tensor:
    """Labels, void where the weight is below a half."""
    return labels(seen).masked_fill(weight(seen)[:, 0] < SURE, VOID)


def where_equal(seen: Seen) -> Tensor:
    """Labels, void where those of the mirror image differ."""
    return labels(seen).masked_fill(labels(seen) != seen.mirror.argmax(1), VOID)


def soft(seen: Seen) -> Tensor:
    return seen.picture


def soft_of_both(seen: Seen) -> Tensor:
    return seen.mean


def evened(seen: Seen) -> Tensor:
    """Probabilities of the scores minus their mean over the picture, divided by their deviation."""
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


def page(data: Path, cached: Path) -> Iterator[str]:
    chosen = [search for search in searches(data) if is_of_scores(search)]
    names = [search.name.removesuffix(f", {NETWORK}").split(",")[0] for search in chosen]
    yield HEAD
    for title, followed in (("Single frames", False), ("Followed", True)):
        yield f"## {title}\n"
        yield from head_row("votes", *names, "mean", "mean of the first halves")
        for way in WAYS:
            halves = np.array([rates(search, data, cached, way, followed) for search in chosen])
            second, first = halves[:, 1], halves[:, 0].mean()
            yield row(way, *(f"{each:.3f}" for each in (*second, second.mean(), first)))
        yield ""


def is_of_scores(search: Search) -> bool:
    """Whether both traverses are outputs of this network; only one drive of CamVid is taken."""
    parts = (search.queries, search.references)
    return all(part[1] == f"predicted_{NETWORK}" and LONG not in part[0] for part in parts)


def rates(
    search: Search, data: Path, cached: Path, way: str, followed: bool
) -> tuple[float, float]:
    """RecallRate@1 of the first and of the second half of the queries."""
    here, there = (
        standardise(described(data, cached, folder[0], way)[rows])
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
def described(data: Path, cached: Path, folder: str, way: str) -> Tensor:
    """The descriptors of a traverse by one of `WAYS`."""
    config = SSRVLADConfig.from_preset("default", labels_as=LABELS_AS)
    hard, twin, parts = SSRVLAD(config), SoftSSRVLAD(config), []
    for batch in torch.from_numpy(scores_of(data, cached, folder)).split(BATCH):
        picture, mirror = batch.float().unbind(1)
        voted = WAYS[way](Seen(picture.softmax(1), mirror.softmax(1), picture))
        with torch.no_grad():
            parts.append((hard if voted.ndim == 3 else twin)(voted).float())
    return torch.cat(parts)


def scores_of(data: Path, cached: Path, folder: str) -> np.ndarray:
    """``(N, 2, C, h, w)`` float16 class scores of pictures and of their mirror images."""
    file = cached / f"{folder} {NETWORK}.npy".replace("/", " ")
    if not file.exists():
        segmenter = Segmenter.load(data / "networks" / f"{NETWORK}.yaml", LABELS_AS)
        pictures = map(read_image, find_image_files([str(data / folder / "images")]))
        np.save(file, np.stack([seen_by(segmenter, picture) for picture in pictures]))
        print(file, flush=True)
    scores: np.ndarray = np.load(file, mmap_mode="c")
    return scores


@torch.inference_mode()
def seen_by(segmenter: Segmenter, picture: np.ndarray) -> np.ndarray:
    both = torch.from_numpy(np.stack([picture, picture[:, ::-1]]))
    straight, mirrored = avg_pool2d(segmenter.labels.outputs(both), STRIDE)
    return torch.stack([straight, mirrored.flip(2)]).half().numpy()


if __name__ == "__main__":
    main()
