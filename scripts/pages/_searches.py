"""Searches on real drives by label maps and by pictures: which frames, and their true matches."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _described import NETWORKS
from _halves import CAMVID, DRIVES, ROUTES
from conditions import BATCH
from torch import Tensor

from ssrvlad_torch import SSRVLAD, baselines
from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.datasets.image_files import find_image_files, read_image
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.taxonomy import label_space


class Search(NamedTuple):
    """A condition: folders of queries and references, which rows of them, and the true matches."""

    name: str
    queries: tuple[str, str, str]
    references: tuple[str, str, str]
    query_rows: np.ndarray
    reference_rows: np.ndarray
    truth: list[np.ndarray]


def by_labels(folder: Path, labels_as: str) -> Tensor:
    space, head = label_space(labels_as), SSRVLAD.from_preset("default", labels_as=labels_as)
    maps = np.stack([read_label_map(file, space) for file in find_label_files([str(folder)])])
    return torch.cat([head.sweep(part, COLUMNS) for part in torch.from_numpy(maps).split(BATCH)])


def by_grid(folder: Path, labels_as: str) -> Tensor:
    space = label_space(labels_as)
    frames = (
        Frame(file.frame, read_label_map(file, space), labels_as)
        for file in find_label_files([str(folder)])
    )
    return _encoded("label-grid", frames)


def by_hog(folder: Path) -> Tensor:
    files = find_image_files([str(folder)])
    return _encoded("hog", (Frame(file.frame, image=read_image(file)) for file in files))


def _encoded(method: str, frames: Iterable[Frame]) -> Tensor:
    found = baselines.make(method).encode_query(frames)
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
