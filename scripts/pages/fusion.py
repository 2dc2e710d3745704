#!/usr/bin/env python3
"""Writes docs/fusion.md: label maps and pictures together.

    .venv/bin/python scripts/pages/fusion.py --data ../shared/data

The folder holds `camvid`, `uofa` and `gardens_walk`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _described import NETWORKS
from _halves import CAMVID, DRIVES, ROUTES, rate
from _markdown import head_row, row, write
from conditions import BATCH
from torch import Tensor

from ssrvlad_torch import SSRVLAD, LoopDetector, baselines, follow, standardise
from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.encoding.extra_descriptors import extra_descriptors
from ssrvlad_torch.recognition.fusion import FusedScores
from ssrvlad_torch.recognition.recognise import Steps, recognise
from ssrvlad_torch.recognition.sweep import COLUMNS, narrowed, score
from ssrvlad_torch.taxonomy import label_space

HEAD = """# Label maps and pictures together

Written by `scripts/pages/fusion.py`. **If you have pictures, use both for sequences**: *both* is
hardly ever worse than the better of the two and mostly better than both, and you need not know
which is better.

The tables show RecallRate@1 of `default` (label maps), of HOG (pictures), and of *both*, as
computed by `encode --with hog` and `query`, or by `compare --fuse ssr-vlad,hog`:

- The scores of each method are standard deviations from their mean over all references (z-scores).
- A method has more weight if its first candidates are farther ahead on this traverse. No ground
  truth is used.
- All descriptors are standardised, and `default` is swept. *Followed* is online
  ([steps](recognition.md)).

Four rules for the weight were tried on these conditions. They differ by a few hundredths at most,
so this is no independent test of the chosen rule.
"""
ALONE = """
## Picture by picture

Each query alone, as in `locate` and `Localiser`:

- Nothing is standardised, because the mean of one frame describes its place.
- Both methods have the same weight. Two other rules were worse on UofA and Gardens Point and
  hardly better on CamVid: by the lead of the frame's first candidate, and by how well each method
  distinguishes the neighbours of a frame of the map from other frames.
- *Both* is always better than `default`, but not always better than HOG.
- The last column is the mean confidence of *both*. Confidence was fitted to label maps, not to
  pictures.
"""
LOOPS = """
## Loops

References and then queries are one stream for a `LoopDetector` with its defaults. The table shows
the fraction of the queries that close a right loop and, in brackets, the precision. Few or no
loops are accepted after a change of light, from the other side of a path, and in drives of sixty
frames.
"""
DETECTORS = (("labels", False), ("pictures", False), ("labels", True))


class Search(NamedTuple):
    """A condition: folders of queries and references, which rows of them, and the true matches."""

    name: str
    queries: tuple[str, str, str]
    references: tuple[str, str, str]
    query_rows: np.ndarray
    reference_rows: np.ndarray
    truth: list[np.ndarray]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, required=True)
    arguments.add_argument("--output", type=Path, default=Path("docs/fusion.md"))
    arguments.add_argument("--cache", type=Path, default=Path(".cache/fusion"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.cache.mkdir(parents=True, exist_ok=True)
    write(options.output, "\n".join(page(options.data, options.cache)) + "\n")


def page(data: Path, cached: Path) -> Iterator[str]:
    yield HEAD
    yield from head_row(
        "condition",
        *("default", "HOG", "both", "weight of default"),
        *("default, followed", "HOG, followed", "both, followed"),
    )
    for search in searches(data):
        alone = [scores(search, data, cached, way) for way in ("labels", "pictures")]
        both = FusedScores(alone)
        every = [*alone, both.whole()]
        single = [rate(one.argmax(1).numpy(), search.truth) for one in every]
        places = [follow(one, [""] * one.shape[1], mode="online").indices[:, 0] for one in every]
        followed = [rate(rows.numpy(), search.truth) for rows in places]
        figures = [f"{each:.3f}" for each in (*single, both.weights[0], *followed)]
        yield row(search.name, *figures)
    yield ALONE
    yield from head_row("condition", "default", "HOG", "both", "confidence")
    for search in searches(data):
        yield row(search.name, *(f"{each:.3f}" for each in by_picture(search, data, cached)))
    yield LOOPS
    yield from head_row("condition", "default", "HOG", "both")
    for search in searches(data):
        yield row(search.name, *(loops(search, data, cached, *ways) for ways in DETECTORS))
    yield ""


def loops(search: Search, data: Path, cached: Path, own: str, beside: bool) -> str:
    """Recall and precision of the references and then the queries as one stream."""
    detector = LoopDetector(beside=extra_descriptors(["hog"], None) if beside else ())
    middle = [COLUMNS.index(column) for column in detector.columns]
    right = accepted = 0
    for drive, (folder, rows) in enumerate(
        ((search.references, search.reference_rows), (search.queries, search.query_rows))
    ):
        frames = described(data, cached, folder, own)[rows]
        frames = frames[:, middle] if own == "labels" else frames
        pictures = described(data, cached, folder, "pictures")[rows]
        for number, (frame, picture) in enumerate(zip(frames, pictures, strict=True)):
            record = FrameRecord(str(drive), str(number))
            found = detector.observe(record, frame, {"hog": picture} if beside else None)
            accepted += found.accepted
            lap, _, place = (found.candidate or "").partition("/")
            if found.accepted and (drive, lap) == (1, "0"):
                right += int(place) in search.truth[number]
    recall = right / len(search.query_rows)
    return f"{recall:.3f} ({right / accepted:.3f})" if accepted else "no loop"


def by_picture(search: Search, data: Path, cached: Path) -> Iterator[float]:
    """RecallRate@1 of `default`, of HOG and of both, and the mean confidence of the latter."""
    labels, pictures = (
        (
            described(data, cached, search.queries, way)[search.query_rows],
            described(data, cached, search.references, way)[search.reference_rows],
        )
        for way in ("labels", "pictures")
    )
    labels = labels[0], labels[1][:, COLUMNS.index(0)]
    names = list(map(str, search.query_rows)), ["map"] * len(search.reference_rows)
    alone = Steps(follow=None)
    found = [
        recognise(*labels, *names, alone, 1),
        recognise(*pictures, *names, alone, 1),
        recognise(*labels, *names, alone, 1, beside={"hog": pictures}),
    ]
    yield from (rate(each.matches.indices[:, 0].numpy(), search.truth) for each in found)
    yield float(found[-1].confidence.mean())


def scores(search: Search, data: Path, cached: Path, way: str) -> Tensor:
    """``(Q, R)`` of standardised single frames; of label maps swept."""
    there = described(data, cached, search.references, way)[search.reference_rows]
    here = described(data, cached, search.queries, way)[search.query_rows]
    if way == "pictures":
        return score(standardise(here), standardise(there))
    references = standardise(there[:, COLUMNS.index(0)])
    return score(narrowed(here, references)[0], references)


@cache
def described(data: Path, cached: Path, traverse: tuple[str, str, str], way: str) -> Tensor:
    """The descriptors of a traverse: a folder, its label maps and their label space."""
    folder, labels, labels_as = traverse
    name = f"{folder} {'images' if way == 'pictures' else labels}".replace("/", " ")
    file = cached / f"{name}.pt"
    if not file.exists():
        torch.save(
            by_labels(data / folder / labels, labels_as)
            if way == "labels"
            else by_hog(data / folder / "images"),
            file,
        )
        print(name, flush=True)
    found: Tensor = torch.load(file)
    return found


def by_labels(folder: Path, labels_as: str) -> Tensor:
    space, head = label_space(labels_as), SSRVLAD.from_preset("default", labels_as=labels_as)
    maps = np.stack([read_label_map(file, space) for file in find_label_files([str(folder)])])
    return torch.cat([head.sweep(part, COLUMNS) for part in torch.from_numpy(maps).split(BATCH)])


def by_hog(folder: Path) -> Tensor:
    files = find_image_files([str(folder)])
    frames = (Frame(file.frame, image=read_image(file)) for file in files)
    found = baselines.make("hog").encode_query(frames)
    assert isinstance(found, Tensor)
    return found


def searches(data: Path) -> Iterator[Search]:
    for network in NETWORKS:
        for name, (queries, references, reach) in ROUTES.items():
            rows = np.arange(len(list((data / queries / "images").iterdir())))
            truth = [np.flatnonzero(abs(rows - number) <= reach) for number in rows]
            here, there = (
                (folder, f"predicted_{network}", "cityscapes-trainids")
                for folder in (queries, references)
            )
            yield Search(f"{name}, {network}", here, there, rows, rows, truth)
    same = json.loads((data / "camvid" / "same_place_odd_even.json").read_text())
    spaces = {"labels": "camvid-11"}
    for drive in DRIVES:
        names = [file.stem for file in sorted((data / "camvid" / drive / "labels").iterdir())]
        odd, even = np.arange(1, len(names), 2), np.arange(0, len(names), 2)
        at = {f"{drive}/{names[row]}": number for number, row in enumerate(even)}
        truth = [np.array([at[frame] for frame in same[f"{drive}/{names[n]}"]]) for n in odd]
        for kinds in CAMVID:
            here, there = (
                (f"camvid/{drive}", kind, spaces.get(kind, "cityscapes-trainids")) for kind in kinds
            )
            words = " -> ".join(kind.removeprefix("predicted_") for kind in kinds)
            yield Search(f"{drive}, {words}", here, there, odd, even, truth)


if __name__ == "__main__":
    main()
