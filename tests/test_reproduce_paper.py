"""What pages/reproduce_paper.py rests on: the paper's numbers, and the cache of results."""

import re
from pathlib import Path

import _paper as paper
import _trials as trials
import pytest

PAPER = Path(__file__).parents[2] / "shared" / "paper" / "ssr_vlad.tex"


def test_another_source_of_the_package_takes_no_old_results(monkeypatch, tmp_path):
    kept = trials.Cache(tmp_path)
    assert kept.get(("x", 1), lambda: [1.5]) == kept.get(("x", 1), lambda: [2.5]) == [1.5]
    assert kept.get(("x", 2), lambda: [2.5]) == [2.5]
    monkeypatch.setattr(trials, "_source", lambda: "changed")
    assert kept.get(("x", 1), lambda: [3.5]) == [3.5]


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
    noise = text[text.index("20 times") :]
    line = noise[noise.index("\n") : noise.index("\\hline")]
    assert re.findall(r"\d[\d.]*", line) == list(paper.TABLE_IV.values())
