#!/usr/bin/env python3
"""Writes docs/results.md: recognition on CamVid (camvid-odd-even) and in the synthetic city.

    .venv/bin/python scripts/results.py --camvid ../shared/data/camvid

camvid-odd-even: the even frames of all sequences are the references, the odd frames the queries,
and a query's true matches are its neighbours in the drive. CamVid is not part of this project:
the folder holds one folder a sequence with `labels`, `predicted_espnetv2` and
`predicted_dicenet`. Without it only the city is measured.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ssrvlad_torch import SSRVLAD, match
from ssrvlad_torch.database import FrameSet
from ssrvlad_torch.datasets.label_files import LabelFile, find_label_files, read_label_map
from ssrvlad_torch.datasets.synthetic_city import QUERY, REFERENCE, Conditions, SyntheticCity
from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers, from_poses
from ssrvlad_torch.evaluation.metrics import evaluate
from ssrvlad_torch.matching import temporal_sum
from ssrvlad_torch.stages.layers import categorise, category_table
from ssrvlad_torch.taxonomy import label_space

GRID_SIDE = 7
RESAMPLES = 1000
CITY_SEEDS = range(5)
CITY_FRAMES = 100
CAMVID_CONDITIONS = {
    "labels -> labels": ("labels", "labels"),
    "espnetv2 -> labels": ("predicted_espnetv2", "labels"),
    "dicenet -> espnetv2": ("predicted_dicenet", "predicted_espnetv2"),
}
SPACES = {
    "labels": "camvid-11",
    "predicted_espnetv2": "cityscapes-trainids",
    "predicted_dicenet": "cityscapes-trainids",
}
CITY_CONDITIONS = {
    "0.7 m to the left, other traffic": Conditions(spacing=2.7, lateral_offset=0.7, seed=1),
    "the same, winter, sway, noise": QUERY,
}

Describe = Callable[[np.ndarray, str], Tensor]
"""``(H, W)`` label map and its label space -> descriptor."""


@dataclass(frozen=True)
class Drive:
    """Frames of a drive: ids, poses, label maps and their label space."""

    frames: list[str]
    poses: np.ndarray
    maps: list[np.ndarray]
    labels_as: str


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, default=None)
    arguments.add_argument("--output", type=Path, default=Path("docs/results.md"))
    options = arguments.parse_args()
    sections = [HEAD]
    if options.camvid:
        sections += list(camvid_section(options.camvid))
    sections += list(city_section())
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text("\n".join(sections) + "\n", encoding="utf-8")
    print(options.output)


HEAD = f"""# Results

Written by `scripts/results.py`; no number here is typed by hand. In brackets stand 95 % bootstrap
intervals over the queries ({RESAMPLES} resamples). `label grid` is the trivial baseline: the
fractions of the eight categories in a {GRID_SIDE} x {GRID_SIDE} grid
({8 * GRID_SIDE**2} numbers), square root, normalised. t is the reach of the temporal sum.
"""

COLUMNS = [
    "condition",
    "method",
    "t",
    "RecallRate@1",
    "RecallRate@5",
    "AUC-PR",
    "Recall@100%Precision",
]
TABLE_HEAD = "\n".join(f"| {' | '.join(cells)} |" for cells in (COLUMNS, ["---"] * len(COLUMNS)))


def camvid_section(folder: Path) -> Iterator[str]:
    yield "## CamVid, odd frames against even frames\n"
    yield f"Sequences {', '.join(sorted(path.name for path in folder.iterdir()))} in one database;"
    yield "a true match is a neighbouring frame.\n"
    yield TABLE_HEAD
    drives = {kind: camvid(folder, kind) for kind in SPACES}
    for name, describe in methods().items():
        described = {kind: describe_all(drive, describe) for kind, drive in drives.items()}
        for condition, (query_kind, reference_kind) in CAMVID_CONDITIONS.items():
            queries, references = odd(described[query_kind]), even(described[reference_kind])
            truth = from_frame_numbers(queries.frames, references.frames, 1)
            for reach in (0, 1):
                yield row(condition, name, reach, [(search(queries, references, reach), truth)])
    yield ""


def city_section() -> Iterator[str]:
    yield "## Synthetic city\n"
    yield f"{len(CITY_SEEDS)} cities of {CITY_FRAMES} reference and {CITY_FRAMES} query frames,"
    yield "each searched in its own city; a true match is within 5 m.\n"
    yield TABLE_HEAD
    mapped = [city(seed, REFERENCE) for seed in CITY_SEEDS]
    driven = {
        name: [city(seed, conditions) for seed in CITY_SEEDS]
        for name, conditions in CITY_CONDITIONS.items()
    }
    for name, describe in methods().items():
        references = [describe_all(drive, describe) for drive in mapped]
        for condition, drives in driven.items():
            queries = [describe_all(drive, describe) for drive in drives]
            pairs = list(zip(queries, references, strict=True))
            truths = [from_poses(q.poses, r.poses, 5.0) for q, r in pairs]
            for reach in (0, 3):
                found = [search(*pair, reach) for pair in pairs]
                yield row(condition, name, reach, list(zip(found, truths, strict=True)))
    yield ""


Found = tuple[np.ndarray, np.ndarray]


Searches = list[tuple[Found, list[np.ndarray]]]
"""Candidates and true matches of the queries of each database that was searched."""


def row(condition: str, method: str, reach: int, searches: Searches) -> str:
    """A line of a table over the queries of all searches together."""
    return f"| {condition} | {method} | {reach} | {' | '.join(with_intervals(searches))} |"


def recall_at_1(searches: Searches) -> str:
    """RecallRate@1 with its interval."""
    return with_intervals(searches)[0]


def with_intervals(searches: Searches) -> list[str]:
    """RecallRate@1, RecallRate@5, AUC-PR and Recall@100%Precision, each with its interval."""
    scores = np.concatenate([found[0] for found, _ in searches])
    rows = np.concatenate([found[1] + i * 10**6 for i, (found, _) in enumerate(searches)])
    truth = [matches + i * 10**6 for i, (_, matched) in enumerate(searches) for matches in matched]
    figures = evaluate(scores, rows, truth, at=(1, 5), resamples=RESAMPLES)
    return [
        f"{value:.3f} [{low:.3f}, {high:.3f}]"
        for value, (low, high) in zip(listed(figures), listed(figures["intervals"]), strict=True)
    ]


def listed(figures: dict) -> list:
    return [*figures["recall_at"].values(), figures["auc_pr"], figures["recall_at_100_precision"]]


def methods() -> dict[str, Describe]:
    """SSR-VLAD in both presets, and the trivial baseline."""
    heads = {
        (preset, space): SSRVLAD.from_preset(preset, labels_as=space)
        for preset in ("paper", "default")
        for space in set(SPACES.values())
    }
    for head in heads.values():
        head.compile()

    def ssrvlad(preset: str) -> Describe:
        return lambda labels, space: heads[preset, space](torch.from_numpy(labels)[None])[0]

    return {
        "SSR-VLAD, paper": ssrvlad("paper"),
        "SSR-VLAD, default": ssrvlad("default"),
        "label grid": label_grid,
    }


def label_grid(labels: np.ndarray, labels_as: str) -> Tensor:
    """Square roots of the categories' fractions in the cells of a grid."""
    categories = categorise(torch.from_numpy(labels)[None], *category_table(label_space(labels_as)))
    masks = torch.stack([categories == k for k in range(8)], 1).float()
    fractions = F.adaptive_avg_pool2d(masks, GRID_SIDE)
    return F.normalize(fractions.sqrt().flatten(), dim=0)


def describe_all(drive: Drive, describe: Describe) -> FrameSet:
    """The frames of a drive with their descriptors."""
    descriptors = torch.stack([describe(labels, drive.labels_as) for labels in drive.maps])
    return FrameSet(
        frames=tuple(drive.frames),
        sequences=tuple(frame.rpartition("/")[0] for frame in drive.frames),
        descriptors=descriptors,
        poses=drive.poses,
        empty=~descriptors.any(dim=1).numpy(),
    )


def search(queries: FrameSet, references: FrameSet, reach: int) -> Found:
    """Scores and rows of the best candidates; the references are summed over ``reach`` frames."""
    summed = temporal_sum(references.descriptors, references.sequences, reach)
    scores, rows = match(queries.descriptors, summed, top=10)
    return scores.numpy(), rows.numpy()


def camvid(folder: Path, kind: str) -> Drive:
    """All sequences of CamVid, each named as its folder."""
    files: list[LabelFile] = []
    for sequence in sorted(path.name for path in folder.iterdir()):
        files += find_label_files([str(folder / sequence / kind)], sequence)
    space = label_space(SPACES[kind])
    return Drive(
        [file.frame for file in files],
        np.full((len(files), 3), np.nan),
        [read_label_map(file, space).copy() for file in files],
        SPACES[kind],
    )


def city(seed: int, conditions: Conditions) -> Drive:
    frames = list(SyntheticCity(seed).traverse(CITY_FRAMES, conditions))
    return Drive(
        [f"city{seed}/{frame.name}" for frame in frames],
        np.array([frame.pose for frame in frames]),
        [frame.labels for frame in frames],
        "cityscapes-trainids",
    )


def even(frames: FrameSet) -> FrameSet:
    return every_other(frames, 0)


def odd(frames: FrameSet) -> FrameSet:
    return every_other(frames, 1)


def every_other(frames: FrameSet, start: int) -> FrameSet:
    """Of each sequence frame ``start`` and every second after it."""
    sequences = np.array(frames.sequences)
    chosen = [np.flatnonzero(sequences == name)[start::2] for name in dict.fromkeys(sequences)]
    rows = np.concatenate(chosen)
    return FrameSet(
        frames=tuple(frames.frames[row] for row in rows),
        sequences=tuple(frames.sequences[row] for row in rows),
        descriptors=frames.descriptors[rows],
        poses=frames.poses[rows],
        empty=frames.empty[rows],
    )


if __name__ == "__main__":
    main()
