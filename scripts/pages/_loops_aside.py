"""What the best anchor of a frame tells of where its camera stands: a section of `loops.py`.

Frames of drives through a city, aside of the reference or turned, and the nearest reference frame
of each; its best anchor (`recognition.sweep`), against how far it truly is aside and turned.
"""

from __future__ import annotations

from collections.abc import Iterator

import conditions
import numpy as np
import torch
from _described import OURS, head
from _markdown import head_row, row
from conditions import TRAIN_IDS, Drive

from ssrvlad_torch.datasets.synthetic_city import Conditions
from ssrvlad_torch.recognition.sweep import COLUMNS

CITY, METRES = 0, 5.5
PLACED = ((0.0, 0.0), (2.0, 0.0), (4.0, 0.0), (-2.0, 0.0), (0.0, 5.0), (0.0, -10.0), (2.0, 5.0))
"""Metres to the left of the reference, and degrees."""


def aside_table() -> Iterator[str]:
    """A row for each kind of labels: the correlation with the best anchor, and the mean error of a
    fitted line beside that of a constant."""
    measured = ("turned: correlation", "degrees", "constant", "aside: correlation", "m", "constant")
    yield from head_row("labels", "frames", *measured)
    for name, noise in (("perfect", 0.0), ("noisy", 1.0)):
        columns, *truths = best_anchors(noise)
        cells = [str(len(columns))]
        for truth in truths:
            line = np.polyval(np.polyfit(columns, truth, 1), columns)
            errors = (np.abs(truth - guess).mean() for guess in (line, truth.mean()))
            correlation = np.corrcoef(columns, truth)[0, 1]
            cells += [f"{value:.2f}" for value in (correlation, *errors)]
        yield row(name, *cells)


def best_anchors(noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each frame the column of its best anchor, degrees turned and metres aside."""
    reference = conditions.city(CITY, Conditions(noise=noise))
    known = described(reference)[:, COLUMNS.index(0)]
    found = []
    for left, turned in PLACED:
        given = Conditions(lateral_offset=left, heading_offset=turned, seed=1, noise=noise)
        drive = conditions.city(CITY, given)
        for pose, swept in zip(drive.poses, described(drive), strict=True):
            x, y, turn = (pose - reference.poses).T
            turn = np.angle(np.exp(1j * turn))
            near = np.flatnonzero((np.hypot(x, y) <= METRES) & (np.abs(turn) < np.pi / 4))
            if not len(near):
                continue
            scores = swept @ known[near].T
            column, place = divmod(int(scores.argmax()), len(near))
            at, heading = near[place], reference.poses[near[place], 2]
            aside = y[at] * np.cos(heading) - x[at] * np.sin(heading)
            found.append((COLUMNS[column], np.degrees(turn[at]), aside))
    columns, degrees, metres = np.array(found, float).T
    return columns, degrees, metres


def described(drive: Drive) -> torch.Tensor:
    """``(N, S, 480)``, from all anchors."""
    made, maps = head(OURS, TRAIN_IDS), torch.from_numpy(drive.maps)
    return torch.cat([made.sweep(part, COLUMNS) for part in maps.split(conditions.BATCH)])
