"""scripts/pages/methods.py on small data: its page, and how costs are measured."""

import types

import numpy as np
import pytest
import torch

from scripts import load, quick, table, write_camvid, write_vpr_bench
from ssrvlad_torch.baselines import Frame

RESULTS = """data set,condition,method,way,RecallRate@1
UofA,evening,HOG,single frames,0.4
Gardens Point,night,HOG,single frames,0.6
City,clean,HOG,single frames,0.1
UofA,evening,HOG,with the steps,0.9
"""


@pytest.fixture(scope="module")
def page_file(patch, tmp_path_factory):
    """The page of a small CamVid and a small corridor."""
    home = tmp_path_factory.mktemp("home")
    script = load("methods", patch)
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
    (home / "docs").mkdir()
    (home / "docs" / "results.csv").write_text(RESULTS)
    script.main()
    return told["--output"]


@pytest.fixture(scope="module")
def page(page_file):
    return page_file.read_text()


def test_every_method_has_a_line(page):
    lines = {cells[0]: cells[1:] for cells in table(page, "# Methods")}
    assert {"SSR-VLAD, paper", "label grid", "CoHOG", "Region-VLAD (random weights)"} <= set(lines)
    size = str(4 * 480)
    assert lines["label grid"][:2] == lines["SSR-VLAD, default"][:2] == ["label maps", size]
    assert lines["HOG"][-2:] == ["0.500", "0.900"]
    assert lines["tiny image"][-2:] == ["-", "-"]
    for name, cells in lines.items():
        assert name == "method" or all(float(cell) > 0 for cell in cells[2:4])


def test_the_least_and_the_most_stand_beside_the_page(page_file):
    lines = page_file.with_suffix(".csv").read_text().splitlines()[1:]
    assert len(lines) == 2 * 7
    for line in lines:
        middle, least, most = map(float, line.split(",")[-3:])
        assert 0 < least <= middle <= most


def test_figures_have_intervals(page):
    corridor = {cells[0]: cells[1:] for cells in table(page, "## Corridor: images -> images")}
    assert corridor["HOG"][0] == "1.000 [1.000, 1.000]"
    assert corridor["Region-VLAD"] == ["weights not here"] * 4
    assert "label grid" not in corridor


def test_stored_results_stand_beside_ours(page):
    (_, cells) = table(page, "## Corridor: what VPR-Bench stored")
    assert cells[:2] == ["CoHOG", "0.500 [0.000, 1.000]"]
    assert cells[-1] == "50.0%"


def test_what_is_missing_is_named(page):
    missing = page[page.index("## What could not be run") :]
    assert "- Region-VLAD: no weights at" in missing
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
