#!/usr/bin/env python3
"""Writes docs/recognition.md: what standardising, sweeping and following are worth, and how sure.

    .venv/bin/python scripts/pages/recognition.py --data ../shared/data

The cities and CamVid are those of `conditions.py`; the real traverses are folders with
``predicted_espnetv2`` and ``images``. Descriptors are kept in `--cache`, so that another run takes
minutes. With ``--fit`` it prints the coefficients for `recognition.confidence` instead: fitted to
the real traverses, to CamVid and to cities that are not measured.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from _markdown import head_row, interval, paragraph, row, write
from conditions import (
    BATCH,
    CAMVID_CONDITIONS,
    CITY_CONDITIONS,
    CITY_SEEDS,
    METRES,
    RESAMPLES,
    Drive,
    camvid,
    city,
)
from torch import Tensor

from ssrvlad_torch import SSRVLAD, baselines
from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.datasets.image_files import decode_image
from ssrvlad_torch.datasets.label_files import find_label_files, read_label_map
from ssrvlad_torch.datasets.synthetic_city import REFERENCE
from ssrvlad_torch.evaluation.ground_truth import from_poses
from ssrvlad_torch.evaluation.metrics import evaluate
from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps, recognise
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.taxonomy import label_space

REAL = {
    "evening -> day": ("uofa/evening", "uofa/day", 1),
    "right -> left": ("gardens_walk/day_right", "gardens_walk/day_left", 2),
    "night -> right": ("gardens_walk/night_right", "gardens_walk/day_right", 2),
    "night -> left": ("gardens_walk/night_right", "gardens_walk/day_left", 2),
}
"""Queries, references, and how many rows a true match may be away."""

STEPS = {
    "single frames": AS_PAPER,
    "standardised": Steps(sweep=False, follow=None),
    "and swept": Steps(follow=None),
    "and followed online": Steps(follow="online"),
    "and followed offline": Steps(),
}
METHODS = ("default", "label grid", "HOG")
LEARNED_ON = (10, 11)
BINS = 10

HEAD = f"""# How to get the most out of it

Written by `scripts/pages/recognition.py`; no number here is typed by hand. RecallRate@1, in
brackets 95 % bootstrap intervals over the queries ({RESAMPLES} resamples). Each column adds a step
to the one before; the baselines, a label grid and HOG of the picture, get the same steps, but the
sweep, which they do not have.

- *Standardise*: each traverse's own mean is taken off its descriptors (Schubert et al., ICRA 2020).
  It costs nothing. A stream takes the mean so far.
- *Sweep*: a query is described from several anchors and a reference scores its best; how wide the
  sweep is, is chosen for each traverse from its scores. It costs a search for each anchor.
- *Follow*: a hidden Markov model over the rows of the map, whose state is place and speed. It costs
  a few passes over one number a row for each query. Queries that are no sequence are noticed and
  judged one by one.

City: {len(CITY_SEEDS)} cities, a true match is within {METRES:g} m. CamVid: odd against even
frames; all frames of a stop are one place. The real traverses are the outputs of a network that was
trained elsewhere; their frames correspond one to one, at nearly equal speeds, which favours any
sequence filter.
"""


@dataclass(frozen=True)
class Search:
    """Queries, references and true matches, by ids of drives and rows of them."""

    queries: str
    references: str
    truth: list[np.ndarray]
    query_rows: list[int] | None = None
    reference_rows: list[int] | None = None


@dataclass
class Described:
    """Descriptors of drives by every method, made once and kept on the disk."""

    data: Path | None
    cache: Path
    known: dict[str, dict[str, Any]] = field(default_factory=dict)

    def drive(self, name: str) -> Drive:
        """The drive of ``city SEED CONDITION NUMBER``, ``camvid KIND`` or ``real FOLDER``."""
        kind, _, rest = name.partition(" ")
        if kind == "city":
            seed, _, condition = rest.partition(" ")
            if condition == "reference":
                return city(int(seed), REFERENCE)
            named, _, number = condition.rpartition(" ")
            return city(int(seed), CITY_CONDITIONS[named][int(number)])
        assert self.data
        return camvid(self.data / "camvid", rest) if kind == "camvid" else real(self.data / rest)

    def __call__(self, name: str) -> dict[str, Any]:
        """Descriptors by method, those of ``default`` a sweep; ``frames`` and ``poses``."""
        file = self.cache / f"{name.replace(' ', '_').replace('/', '_')}.pt"
        if name not in self.known:
            if not file.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                torch.save(described(self.drive(name)), file)
                print(name, flush=True)
            self.known[name] = torch.load(file)
        return self.known[name]


def described(drive: Drive) -> dict[str, Any]:
    head = SSRVLAD.from_preset("default", labels_as=drive.labels_as)
    batches = torch.from_numpy(drive.maps).split(BATCH)
    found: dict[str, Any] = {"frames": list(drive.frames), "poses": torch.from_numpy(drive.poses)}
    found["default"] = torch.cat([head.sweep(batch, COLUMNS) for batch in batches])
    pictures = [decode_image(path.read_bytes()) for path in drive.pictures]
    frames = [
        Frame(name, labels, drive.labels_as, pictures[number] if pictures else None)
        for number, (name, labels) in enumerate(zip(drive.frames, drive.maps, strict=True))
    ]
    found["label grid"] = baselines.make("label-grid").encode_query(iter(frames))
    if pictures:
        found["HOG"] = baselines.make("hog").encode_query(iter(frames))
    return found


def real(folder: Path) -> Drive:
    """A real traverse as ESPNetv2 sees it."""
    space = label_space("cityscapes-trainids")
    files = find_label_files([str(folder / "predicted_espnetv2")], folder.name)
    return Drive(
        tuple(file.frame for file in files),
        np.full((len(files), 3), np.nan),
        np.stack([read_label_map(file, space) for file in files]),
        space.name,
        tuple(next((folder / "images").glob(f"{file.name}.*")) for file in files),
    )


def conditions(
    described: Described, seeds: Sequence[int] = CITY_SEEDS
) -> Iterator[tuple[str, list[Search]]]:
    """Every condition's name and searches."""
    if described.data:
        for name, (queries, references, rows) in REAL.items():
            count, others = (
                len(described(f"real {part}")["default"]) for part in (queries, references)
            )
            near = np.arange(others)
            truth = [np.flatnonzero(abs(near - number) <= rows) for number in range(count)]
            yield name, [Search(f"real {queries}", f"real {references}", truth)]
        places = json.loads((described.data / "camvid/same_place_odd_even.json").read_text())
        frames = described("camvid labels")["frames"]
        odd, even = every_other(frames, 1), every_other(frames, 0)
        row_of = {frames[number]: place for place, number in enumerate(even)}
        truth = [np.array([row_of[f] for f in places[frames[n]]], np.int64) for n in odd]
        for name, (query_kind, reference_kind) in CAMVID_CONDITIONS.items():
            yield (
                name,
                [Search(f"camvid {query_kind}", f"camvid {reference_kind}", truth, odd, even)],
            )
    for name, drives in CITY_CONDITIONS.items():
        yield (
            name,
            [
                Search(
                    f"city {seed} {name} {number}",
                    f"city {seed} reference",
                    from_poses(
                        described(f"city {seed} {name} {number}")["poses"].numpy(),
                        described(f"city {seed} reference")["poses"].numpy(),
                        METRES,
                    ),
                )
                for seed in seeds
                for number in range(len(drives))
            ],
        )


def sequences(frames: Sequence[str]) -> list[str]:
    return [frame.rpartition("/")[0] for frame in frames]


def every_other(frames: Sequence[str], start: int) -> list[int]:
    """Of each sequence the rows of frame ``start`` and every second after it."""
    names = np.array(sequences(frames))
    chosen = [np.flatnonzero(names == name)[start::2] for name in dict.fromkeys(names)]
    return np.concatenate(chosen).tolist()


def decisions(
    described: Described, searches: Sequence[Search], method: str, steps: Steps
) -> tuple[list[list[float]], list[list[int]], list[np.ndarray], Tensor] | None:
    """Scores, rows and truth of all queries, and their confidences; `None` without pictures."""
    scores, rows, truth, sure = [], [], [], []
    for number, search in enumerate(searches):
        both = described(search.queries), described(search.references)
        if method not in both[0]:
            return None
        queries, references = (part[method] for part in both)
        if references.ndim == 3:
            references = references[:, COLUMNS.index(0)]
        here, there = (sequences(part["frames"]) for part in both)
        asked = search.query_rows or list(range(len(queries)))
        kept = search.reference_rows or list(range(len(references)))
        found = recognise(
            queries[asked],
            references[kept],
            [here[n] for n in asked],
            [there[n] for n in kept],
            steps,
            top=5,
        )
        offset = number * 10**6
        scores += found.matches.scores.tolist()
        rows += (found.matches.indices + offset).tolist()
        truth += [places + offset for places in search.truth]
        sure.append(found.confidence)
    return scores, rows, truth, torch.cat(sure)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, help="folder of camvid, uofa and gardens_walk")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/recognition"))
    arguments.add_argument("--fit", action="store_true", help="print coefficients of confidence")
    arguments.add_argument("--output", type=Path, default=Path("docs/recognition.md"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    if options.fit:
        fit(described)
        return
    write(options.output, "\n".join(page(described)) + "\n")


def page(described: Described) -> Iterator[str]:
    yield HEAD
    told: dict[str, list[tuple[Tensor, np.ndarray]]] = {name: [] for name in STEPS}
    for method in METHODS:
        yield f"## {method}\n"
        yield from head_row("condition", *STEPS)
        for name, searches in conditions(described):
            cells = []
            for step, steps in STEPS.items():
                found = decisions(described, searches, method, steps)
                if found is None:
                    break
                scores, rows, truth, sure = found
                figures = evaluate(
                    np.array(scores), np.array(rows), truth, at=(1,), resamples=RESAMPLES
                )
                ends = figures["intervals"]["recall_at"]["1"]
                cells.append(interval(figures["recall_at"]["1"], ends))
                if method == "default" and name in CITY_CONDITIONS:
                    told[step].append((sure, right(rows, truth)))
            if cells:
                yield row(name, *cells)
        yield ""
    yield "## How sure\n"
    yield paragraph(
        "The confidence of each first candidate against how often it is right, in the cities "
        f"above, none of which it was fitted to; {BINS} bins of equal width, and the expected "
        "calibration error over them."
    )
    ends = [f"{n / BINS:g} to {(n + 1) / BINS:g}" for n in range(BINS)]
    yield from head_row("steps", "error", *ends)
    for step, pairs in told.items():
        if step not in ("single frames", "standardised"):
            sure = torch.cat([each for each, _ in pairs]).numpy()
            yield row(step, *reliability(sure, np.concatenate([hits for _, hits in pairs])))


def right(rows: list[list[int]], truth: list[np.ndarray]) -> np.ndarray:
    return np.array([first[0] in set(places) for first, places in zip(rows, truth, strict=True)])


def reliability(sure: np.ndarray, hits: np.ndarray) -> list[str]:
    """The calibration error, and how often the queries of each bin are right."""
    bins = np.minimum((sure * BINS).astype(int), BINS - 1)
    error, cells = 0.0, []
    for number in range(BINS):
        inside = bins == number
        cells.append(f"{hits[inside].mean():.2f} of {inside.sum()}" if inside.any() else "")
        if inside.any():
            error += inside.mean() * abs(sure[inside].mean() - hits[inside].mean())
    return [f"{error:.3f}", *cells]


def fit(described: Described) -> None:
    """Prints offset and slope of the confidence over that of the module, for each way."""
    for step in list(STEPS)[2:]:
        sure, hits = [], []
        for _, searches in conditions(described, LEARNED_ON):
            found = decisions(described, searches, "default", STEPS[step])
            assert found
            sure.append(found[3])
            hits.append(right(found[1], found[2]))
        truth = torch.from_numpy(np.concatenate(hits)).double()
        offset, slope = logistic(torch.logit(torch.cat(sure).double(), 1e-4), truth)
        print(f"{step}: offset {offset:.2f} and slope {slope:.2f} over the present logit")


def logistic(told: Tensor, truth: Tensor) -> list[float]:
    """Offset and slope of the logistic regression of what is true on what is told."""
    weights = torch.tensor([0.0, 1.0], dtype=torch.double, requires_grad=True)
    search = torch.optim.LBFGS([weights], max_iter=200)

    def loss() -> Tensor:
        search.zero_grad()
        value = F.binary_cross_entropy_with_logits(weights[0] + weights[1] * told, truth)
        value.backward()
        return value

    search.step(loss)
    return weights.tolist()


if __name__ == "__main__":
    main()
