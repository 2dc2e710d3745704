"""A small part of docs/evaluation/confidence.csv: what breaks a drive or the map, in a city."""

from functools import cache

import numpy as np
import pytest
import torch

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.synthetic_city import REFERENCE, Conditions, SyntheticCity
from ssrvlad_torch.recognition.recognise import Steps, recognise, references_of
from ssrvlad_torch.recognition.sequences import SAME_PLACE_ROWS
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.search.answers import accept, estimate

CITY, FRAMES = 31, 90
DRIVES = {
    "reference": REFERENCE,
    "query": Conditions(spacing=2.7, lateral_offset=0.7, seed=1),
    "back": Conditions(spacing=2.7, lateral_offset=0.7, seed=3, heading_offset=180.0),
}
HALF = FRAMES // 2
PARTS = {
    "half": (("reference", slice(HALF)),),
    "turned": (("query", slice(HALF)), ("back", slice(HALF, None))),
}
STEPS = {"alone": Steps(follow=None), "online": Steps(follow="online"), "offline": Steps()}
RANDOM = np.random.default_rng(0)


@cache
def drive(seed: int, name: str) -> tuple[torch.Tensor, np.ndarray]:
    """Descriptors from all anchors, and poses; the way back in the order of time."""
    if name in PARTS:
        parts = [[each[some] for each in drive(seed, part)] for part, some in PARTS[name]]
        descriptors, poses = zip(*parts, strict=True)
        return torch.cat(descriptors), np.concatenate(poses)
    head = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")
    frames = list(SyntheticCity(seed).traverse(FRAMES, DRIVES[name], (90, 120)))
    labels = torch.from_numpy(np.stack([frame.labels for frame in frames]))
    found, poses = head.sweep(labels, COLUMNS), np.array([frame.pose for frame in frames])
    return (found.flip(0), poses[::-1]) if name == "back" else (found, poses)


def found_in(rows, place, steps, asked="query"):
    """What is recognised of some frames of one drive in the map of another, and which answers are
    another place."""
    (queries, at), (references, known) = drive(CITY, asked), drive(*place)
    queries, at = queries[[*rows]], at[[*rows]]
    town = references_of({"x": references[:, len(COLUMNS) // 2]}, ["map"] * len(references))
    found = recognise({"x": queries}, ["q"] * len(queries), town, STEPS[steps], 1)
    x, y, turn = (at[:, None] - known).transpose(2, 0, 1)
    same = (np.hypot(x, y) <= 5) & (np.cos(turn) > 0.5)
    answers = found.matches.indices[:, 0].numpy()
    wrong = [
        min(abs(np.flatnonzero(true) - row), default=np.inf) > SAME_PLACE_ROWS
        for true, row in zip(same, answers, strict=True)
    ]
    return found, np.array(wrong)


def in_turn(streams: int) -> list[int]:
    length = FRAMES // streams
    return [part * length + frame for frame in range(length) for part in range(streams)]


EVERY, SAME, OTHER = range(FRAMES), (CITY, "reference"), (CITY + 1, "reference")
CASES = {
    "as it is": (EVERY, SAME),
    "3 streams in turn": (in_turn(3), SAME),
    "a stop": (sorted([*EVERY, *[30] * 40]), SAME),
    "random frames": (RANDOM.permutation(FRAMES)[:40], SAME),
    "foreign": (EVERY, OTHER),
    "the way back alone": (EVERY, (CITY, "back")),
    "half of the map": (EVERY, (CITY, "half")),
    "a U-turn": (EVERY, SAME, "turned"),
}
"""Frames, the drive in whose map they are looked for, and the drive that they are of."""


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("case", CASES)
def test_what_is_accepted_is_right_and_the_interval_holds(case, steps):
    frames, place, *asked = CASES[case]
    found, wrong = found_in(frames, place, steps, *asked)
    kept, every = accept(found.sure, 0.05), estimate(found.sure)
    taken = found.confidence.numpy() >= kept.confidence
    late = 0.15 if steps == "online" else 0.1  # the first frames after the end of the map
    assert wrong[taken].sum() <= late * taken.sum()
    assert every.low is None or every.low <= wrong.mean() <= every.high
    doubts = 1 - found.confidence.numpy()[taken].astype(float)
    assert kept.wrong * kept.accepted == pytest.approx(doubts.sum(), abs=1e-3)
    if "foreign" in case or "back" in case:
        assert kept.accepted == 0
    else:
        assert kept.accepted > 0.5 * (~wrong).sum()
