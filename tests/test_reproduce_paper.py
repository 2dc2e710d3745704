"""What pages/reproduce_paper.py rests on: the paper's numbers, and the harness of its tables."""

import re
from functools import partial
from pathlib import Path

import _paper as paper
import numpy as np
import pytest
from _described import Condition, Described
from _trials import Rival, try_all
from conditions import CITY_CONDITIONS, Search, city

from ssrvlad_torch.baselines import make
from ssrvlad_torch.baselines.run import run
from ssrvlad_torch.datasets.synthetic_city import REFERENCE

PAPER = Path(__file__).parents[2] / "shared" / "paper" / "ssr_vlad.tex"


def test_a_rival_finds_what_the_package_finds(tmp_path):
    drives = {"back": CITY_CONDITIONS["clean"][0], "map": REFERENCE}
    added = {name: partial(city, 0, each, 8, (60, 80)) for name, each in drives.items()}
    truth = [np.array([row]) for row in range(8)]
    condition = Condition("a", "labels -> labels", [Search("back", "map", truth)])
    rivals = [Rival("grid", "label grid"), Rival("3", "SSR-VLAD, paper", 3), Rival("HOG", "HOG")]
    outcomes = try_all(Described(None, tmp_path, added), [condition], rivals)
    methods = {"grid": make("label-grid"), "3": make("ssr-vlad", preset="paper", temporal=3)}
    assert {rival for _, rival in outcomes} == set(methods)
    for name, method in methods.items():
        wanted = run(method, *(added[drive]().seen() for drive in drives), top=5)
        found = outcomes["a: labels -> labels", name]
        np.testing.assert_array_equal(found.rows, wanted.matches.indices)
        np.testing.assert_allclose(found.scores, wanted.matches.scores, atol=1e-6)


def test_a_rival_without_weights_says_so(tmp_path):
    condition = Condition("a", "images -> images", [Search("map", "map", [np.array([0])])])
    added = {"map": partial(city, 0, REFERENCE, 1, (60, 80))}
    described = Described(None, tmp_path, added, weights=tmp_path)
    outcomes = try_all(described, [condition], [Rival("NetVLAD", "NetVLAD")])
    assert outcomes["a: images -> images", "NetVLAD"].startswith("no weights")


@pytest.mark.skipif(not PAPER.is_file(), reason="the paper of ../shared is not on this machine")
def test_the_papers_numbers_are_those_of_its_source():
    text = PAPER.read_text()
    first, costs = text[text.index("label{table1}") :].split("label{table3}")
    first = re.sub(r"\\textbf\{([^}]*)\}", r"\1", first)
    lines = re.findall(r"\{(?:Recall@100\\%Precision|RecallRate@1|AUC)\}(.*?)\\\\", first, re.S)
    cells = [re.findall(r"(?:\{c\|\}\{|&\s*)([\d.]+|-)(?=\}|\s*$)", line) for line in lines]
    printed = [list(zip(*cells[n : n + 3], strict=True)) for n in (0, 3, 6)]
    assert printed == [list(methods.values()) for methods in paper.TABLE_I.values()]
    cells = re.findall(r"\d[\d.]*/\d[\d.]*/\d[\d.]*", costs[: costs.index("section{Results}")])
    ours = zip(*paper.TABLE_III.values(), strict=True)
    assert cells == [cell for step in ours for cell in step if cell]
