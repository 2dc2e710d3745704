"""scripts/pages/methods.py on small data: its page, and how costs are measured."""

from __future__ import annotations

import re
import types

import numpy as np
import pytest
import torch

from scripts import load, quick, table, write_camvid, write_vpr_bench
from ssrvlad_torch.baselines import Frame


@pytest.fixture(scope="module")
def page(patch, tmp_path_factory):
    """The page of a small CamVid, a small corridor and small cities."""
    home = tmp_path_factory.mktemp("home")
    script, problems = load("methods", patch), load("_problems", patch)
    patch.setattr(problems, "CITY_FRAMES", 5)
    patch.setattr(problems, "CITY_SEEDS", (3,))
    patch.setattr(script, "RIVALS", quick(script.RIVALS))
    patch.setattr(script, "ROUNDS", 3)
    patch.setattr(script, "ROUNDS_OF_NETWORKS", 2)
    told = {
        "--camvid": write_camvid(home / "camvid", 8),
        "--corridor": write_vpr_bench(home / "corridor", 4, labels=False),
        "--cache": home / "cache",
        "--weights": home,
        "--output": home / "docs" / "methods.md",
    }
    likeness = np.eye(4)[[0, 1, 3, 2]]
    truth = {"gt_flat": np.arange(4), "gt_off": np.arange(5)}
    np.savez(home / "corridor_CoHOG.npz", sim=likeness, **truth)
    patch.setattr(
        "sys.argv", ["methods.py", *(str(part) for pair in told.items() for part in pair)]
    )
    script.main()
    return told["--output"].read_text()


def test_every_method_stands_under_every_condition(page):
    short = table(page, "## In short")
    conditions = short[0][1:]
    assert len(conditions) == 3 + 1 + 6
    seen = {cells[0]: [bool(cell) for cell in cells[1:]] for cells in short[1:]}
    labels = ["Corridor" not in name and "images" not in name for name in conditions]
    assert seen["label grid"] == seen["SSR-VLAD, paper, t = 0"] == labels
    assert seen["HOG"] == seen["Region-VLAD"] == [not there for there in labels]


def test_figures_have_intervals(page):
    rows = {cells[0]: cells[1:] for cells in table(page, "## Synthetic city: clean")}
    assert rows["method"] == ["RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision"]
    for cell in (*rows["label grid"], *rows["SSR-VLAD, default, t = 3"]):
        value, low, high = map(float, re.fullmatch(r"(.+) \[(.+), (.+)\]", cell).groups())
        assert 0 <= low <= value <= high <= 1
    assert "HOG" not in rows
    corridor = {cells[0]: cells[1:] for cells in table(page, "## Corridor: images -> images")}
    assert corridor["HOG"][0] == "1.000 [1.000, 1.000]"
    assert corridor["Region-VLAD"] == ["weights not here"] * 4


def test_stored_results_stand_beside_ours(page):
    (_, cells) = table(page, "## Corridor: what VPR-Bench stored")
    assert cells[:2] == ["CoHOG", "0.500 [0.000, 1.000]"]
    assert cells[-1] == "50.0%"


def test_costs_stand_for_every_data_set(page):
    heading = "### CamVid, odd against even: 48 x 64 pixels, 4 references"
    camvid = {cells[0]: cells[1:] for cells in table(page, heading)}
    assert {"SSR-VLAD, paper", "label grid", "CoHOG", "Region-VLAD (random weights)"} <= set(camvid)
    assert camvid["label grid"][0] == camvid["SSR-VLAD, default"][0] == str(4 * 480)
    for name, (_, *times) in camvid.items():
        for cell in times if name != "method" else ():
            middle, low, high = map(float, re.fullmatch(r"(.+) \[(.+), (.+)\]", cell).groups())
            assert 0 < low <= middle <= high
    corridor = {cells[0] for cells in table(page, "### Corridor: 48 x 64 pixels, 4 references")}
    assert "HOG" in corridor
    assert "label grid" not in corridor
    city = {cells[0] for cells in table(page, "### Synthetic city: 240 x 320 pixels, 5 references")}
    assert city == {"method", "SSR-VLAD, paper", "SSR-VLAD, default", "label grid"}


def test_what_is_missing_is_named(page):
    missing = page[page.index("## What could not be run") :]
    assert "- Region-VLAD: no weights at" in missing
    assert "- Corridor, labels: it has no label maps." in missing
    assert "CamVid" not in missing


class Counting:
    """A method that notes what it is asked."""

    name = "counting"
    needs = frozenset({"labels"})

    def __init__(self, noted, name):
        self._noted, self._name = noted, name

    def encode_query(self, frames):
        self._noted.append((self._name, [frame.frame for frame in frames]))
        return torch.ones(1, 3)

    def encode_reference(self, frames):
        return torch.ones(len(list(frames)), 3)

    def scores(self, queries, references):
        self._noted.append((self._name, len(references)))
        return queries @ references.T


def test_methods_take_turns_frame_by_frame(patch):
    costs, noted = load("_costs", patch), []
    frames = [Frame(f"a/{n}", np.zeros((2, 2), np.uint8), "camvid-11") for n in range(2)]
    before = torch.get_num_threads()
    found = costs.measure(
        {name: lambda name=name: Counting(noted, name) for name in ("x", "y")},
        {"x": frames, "y": frames[:1]},
        references=25,
        rounds={"x": 3, "y": 1},
    )
    assert torch.get_num_threads() == before
    asked = [told for told in noted if isinstance(told[1], list)]
    assert asked == [
        *(("x", ["a/1"]), ("y", ["a/0"])),  # the round that is not counted
        *(("x", ["a/0"]), ("y", ["a/0"])),
        *(("x", ["a/1"]), ("x", ["a/0"])),
    ]
    assert {told[1] for told in noted if not isinstance(told[1], list)} == {25}
    assert [len(cost.encode) for cost in found.values()] == [3, 1]
    assert found["x"].aggregate is None
    assert (found["x"].references, found["x"].bytes_a_reference) == (25, 12)


def test_watched_functions_are_timed_and_put_back(patch):
    costs = load("_costs", patch)
    module = types.SimpleNamespace(double=lambda x: 2 * x, other=None)
    double = module.double
    with costs.watched([(module, "double")]) as taken:
        assert module.double(4) == 8
        assert module.double(5) == 10
    assert len(taken) == 2
    assert min(taken) >= 0
    assert module.double is double


@pytest.mark.parametrize(
    ("value", "told"),
    [(0, "0"), (0.00123456, "0.00123"), (1.5, "1.50"), (99.96, "100.0"), (1234.5, "1234")],
)
def test_numbers_keep_three_digits(patch, value, told):
    assert load("_markdown", patch).significant(value) == told
