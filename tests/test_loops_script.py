"""pages/loops.py on streams made by hand in place of tours: its tables against plain counts."""

import math

import numpy as np
import pytest
import torch
from helpers import descriptors

from scripts import load, table
from ssrvlad_torch import SSRVLAD, LoopConfig, LoopDetector
from ssrvlad_torch.database.frames import FrameRecord

LAP, BACK = 90, 20


@pytest.fixture
def script(monkeypatch):
    module = load("loops", monkeypatch)
    monkeypatch.setattr(module, "head", lambda: HEAD)
    return module


HEAD = SSRVLAD.from_preset("default", labels_as="cityscapes-trainids")


def tour(script, seed, noise):
    """Twice round a circle of 180 m, a frame every 2 m, then 20 frames back the other way. Places
    that follow each other look a little alike."""
    rng = np.random.default_rng(seed)
    places = descriptors(seed, LAP).numpy()
    places = places + 0.8 * np.roll(places, 1, axis=0)
    rows = np.concatenate((np.arange(LAP), np.arange(LAP), np.arange(BACK)[::-1])) % LAP
    vectors = places[rows] + noise * rng.standard_normal((len(rows), 480))
    vectors[-BACK:] = descriptors(seed + 1, BACK).numpy()
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    angle = 2 * math.pi * rows / LAP
    heading = angle + math.pi / 2
    heading[-BACK:] += math.pi
    radius = 2 * LAP / (2 * math.pi)
    poses = np.stack((radius * np.cos(angle), radius * np.sin(angle), heading), axis=1)
    return script.Tour(seed, torch.from_numpy(vectors.astype(np.float32)), poses)


def plain_loops(made, threshold):
    """Row of the candidate of each frame that closes a loop."""
    detector = LoopDetector(LoopConfig(threshold=threshold), HEAD)
    found = {}
    for row, descriptor in enumerate(made.descriptors):
        record = FrameRecord("tour", str(row))
        result = detector.observe(record, descriptor)
        if result.accepted:
            found[row] = int(result.candidate.rpartition("/")[2])
    return found


def test_the_page_says_what_the_detectors_did(script, tmp_path):
    learned, measured, checked = (
        {
            "perfect labels": [tour(script, seed, 0.01) for seed in seeds],
            "noisy labels": [tour(script, seed, 0.05) for seed in seeds],
        }
        for seeds in ((10,), (20, 22), (30,))
    )
    made = script.sections(learned, measured, checked, tmp_path / "figures")
    page = "\n".join(line for heading, lines in made.items() for line in (heading, *lines))
    assert "nan" not in page
    for condition in measured:
        head, *rows = table(page, f"## {condition.capitalize()}")
        assert head[2:5] == ["loops", "wrong", "elsewhere"]
        curve = script.curve([script.detect(made) for made in learned[condition]])
        thresholds = {"default": LoopConfig.threshold, "learned": script.surest_point(curve).score}
        assert [line[0] for line in rows] == [*thresholds, "check"]
        assert rows[2][2] == str(len(plain_loops(checked[condition][0], 0.8)))
        for line, threshold in zip(rows, thresholds.values(), strict=False):
            wrong = right = 0
            for made in measured[condition]:
                for row, candidate in plain_loops(made, threshold).items():
                    near = math.dist(made.poses[row, :2], made.poses[candidate, :2]) <= 10
                    right, wrong = right + near, wrong + (not near)
            assert right > 80
            assert [int(cell) for cell in line[2:4]] == [right + wrong, wrong]
            if line[0] == "default":
                found, recalled = right + wrong, right
                begun = [min(plain_loops(made, threshold)) for made in measured[condition]]
        revisits = sum(made.comes_back(50, 10).sum() for made in measured[condition])
        assert rows[0][6].startswith(f"{recalled / revisits:.3f} ")
        where = page[page.index(f"## {condition.capitalize()}") :]
        kinds = {row[0]: [int(cell) for cell in row[1:]] for row in table(where, "By where")[1:]}
        same, other, first, waited, _ = kinds.values()
        assert same[0] == revisits
        assert same[0] + other[0] + first[0] == 2 * (2 * LAP + BACK)
        assert same[1] + other[1] + first[1] == found
        returned = [made.comes_back(50, 10) for made in measured[condition]]
        waits = [each[:row].sum() for each, row in zip(returned, begun, strict=True)]
        assert waited[:2] == [sum(waits), 0]
        reasons = dict(zip(*table(where, "| reason |"), strict=True))
        assert int(reasons["accepted"]) == found
    names = ["loops-curves.png", "loops-noisy.png", "loops-perfect.png"]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == names
    assert all(f"figures/{name})" in page for name in names)


def test_frames_that_come_back(script):
    """The second lap looks the same way from its first frame on, but for the last 50 of the first;
    the way back looks the other way."""
    made = tour(script, 0, 0.0)
    same, opposite = made.comes_back(50, 1.0), made.comes_back(50, 1.0, opposite=True)
    assert np.flatnonzero(same).tolist() == [*range(LAP, 2 * LAP)]
    assert np.flatnonzero(opposite).tolist() == [*range(2 * LAP, 2 * LAP + BACK)]


def test_real_drives_are_counted_frame_by_frame(monkeypatch):
    """A second drive that sees a part of the first, and one of another place."""
    real = load("_loops_real", monkeypatch)
    first, other = (descriptors(seed, 90)[:, None] for seed in (0, 1))
    truth = [np.array([row]) for row in range(20, 60)]
    pair = real.Pair("a", first, first[20:60], {}, {}, truth)
    found = real.detect(pair, ())
    assert (found.right.sum() > 30, found.wrong, found.elsewhere) == (True, 0, 0)
    moved = real.detect(pair._replace(truth=[each + 2 for each in truth]), ())
    assert (moved.right.sum(), moved.wrong, moved.elsewhere) == (0, found.right.sum(), 0)
    nowhere = [np.zeros(0, int)] * 90
    assert real.detect(real.Pair("b", first, other, {}, {}, nowhere), ()).wrong == 0
    cells = real.counted([found, moved])
    assert cells[0].startswith(f"{found.right.mean() / 2:.2f} [") and cells[1] == str(moved.wrong)
