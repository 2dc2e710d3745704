"""Small data for the scripts that write pages, and those scripts as modules; shared by tests."""

import importlib
from collections.abc import Iterable
from dataclasses import replace
from itertools import dropwhile, takewhile
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from drives import vpr_bench
from PIL import Image

from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.taxonomy import colourise

SCRIPTS = Path(__file__).parents[1] / "scripts" / "pages"
TRAIN_IDS = "cityscapes-trainids"


def load(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A script, or one of its parts, as a module."""
    monkeypatch.syspath_prepend(SCRIPTS)
    return importlib.import_module(name)


def quick(rivals: Iterable) -> tuple:
    """Rivals without those that have large networks, CoHOG on small pictures."""
    settings = {"cohog": {"size": 64}}
    return tuple(
        replace(rival, settings={**rival.settings, **settings.get(rival.method, {})})
        for rival in rivals
        if rival.method not in ("netvlad", "lost-x")
    )


def frames(count: int, seed: int = 0) -> list[np.ndarray]:
    """Label maps of the synthetic city in train ids."""
    traverse = SyntheticCity(seed).traverse(count, size=(48, 64), labels_as=TRAIN_IDS)
    return [frame.labels for frame in traverse]


def photo(labels: np.ndarray) -> np.ndarray:
    """An image of a label map: its colours and some texture, the same for the same labels."""
    texture = np.random.default_rng(int(labels.sum())).integers(0, 128, (*labels.shape, 3))
    return (colourise(labels, TRAIN_IDS) // 2 + texture).astype(np.uint8)


def write_camvid(root: Path, count: int, drives: Iterable[str] = ("0001TP",)) -> Path:
    """Drives in the layout of CamVid, through one city each, its labels renamed."""
    names = np.full(256, 11, np.uint8)
    names[[0, 1, 2, 4, 5, 8, 10]] = 3, 4, 1, 7, 2, 5, 0
    for seed, drive in enumerate(drives):
        for number, labels in enumerate(frames(count, seed)):
            pictures = {
                "labels": names[labels],
                "predicted_espnetv2": labels,
                "images": photo(labels),
            }
            for folder, picture in pictures.items():
                path = root / drive / folder / f"{drive}_{number:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(picture).save(path)
    return root


def write_vpr_bench(root: Path, count: int, labels: bool) -> Path:
    """Two equal drives in the layout of VPR-Bench, if wanted with label maps."""
    for part in ("query", "ref"):
        for number, picture in enumerate(frames(count, seed=1)):
            for folder, pixels in (
                (root / part, photo(picture)),
                *([(root / "labels" / part, picture)] if labels else ()),
            ):
                folder.mkdir(parents=True, exist_ok=True)
                Image.fromarray(pixels).save(folder / f"{number:04d}.png")
    np.save(root / "ground_truth_new.npy", vpr_bench([[number] for number in range(count)]))
    return root


def table(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table after a heading, without its second line."""
    lines = page[page.index(heading) :].splitlines()
    rows = dropwhile(lambda line: not line.startswith("|"), lines)
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in takewhile(lambda line: line.startswith("|"), rows)
    ]
    return [cells[0], *cells[2:]]
