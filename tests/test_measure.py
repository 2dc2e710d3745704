"""All metrics of recognised queries: conventions, queries that are left out, estimates."""

import json
import re

import numpy as np
import pytest
from drawings import SPACE, VOID
from helpers import write_maps, write_street, write_truth
from PIL import Image


@pytest.mark.parametrize("convention", ["exact", "vpr-bench"])
def test_an_empty_frame_is_a_query_without_candidate(convention, evaluate, tmp_path):
    Image.fromarray(np.full((24, 32), VOID, np.uint8)).save(tmp_path / "tuesday" / "003.png")
    arguments = ("--tolerance-frames", 0, "--convention", convention, "--json")
    metrics = json.loads(evaluate(*arguments)[1])
    assert metrics["convention"] == convention
    assert metrics["recall_at"]["1"] == pytest.approx(5 / 6)


def test_queries_without_ground_truth_are_left_out_and_counted(evaluate, tmp_path):
    truth = {"tuesday/001": ["monday/001"], "tuesday/004": []}
    path = write_truth(tmp_path / "truth.json", truth)
    code, out, err = evaluate("--ground-truth", path, "--json")
    assert code == 0
    assert err == [f"ssrvlad: 4 of 6 queries are left out: {path} does not name them"]
    metrics = json.loads(out)
    assert (metrics["queries"], metrics["queries_with_match"]) == (2, 1)
    assert metrics["recall_at"]["1"] == 1.0

    truth = {f"tuesday/{n}": ["monday/001"] for n in ("001", "10", "9")}
    path = write_truth(tmp_path / "truth.json", truth)
    _, _, err = evaluate("--ground-truth", path)
    strange = f"2 queries of {path} do not exist, the first is tuesday/9"
    assert f"ssrvlad: {strange}" in err


def test_the_estimate_of_wrong_answers_comes_with_the_truth(ssrvlad, tmp_path):
    """Forty streets; four queries show others."""
    maps, today = write_maps(tmp_path / "town", range(40)), tmp_path / "today"
    write_maps(today, range(4, 40))
    for number in range(4):
        write_street(today / f"{number:03d}.png", 40 + number)
    town = tmp_path / "town.ssrdb"
    assert ssrvlad("encode", maps, "-o", town, "--labels-as", SPACE)[0] == 0
    ask = "evaluate", town, today, "--tolerance-frames", 0, "--follow", "no"
    code, out, _ = ssrvlad(*ask, "--json")
    found = json.loads(out)["estimates"]
    assert code == 0 and list(found) == ["accepted", "suggested_without_truth"]
    for each in found.values():
        assert each["low"] <= each["truly_wrong"] <= each["high"]
    every, suggested = found.values()
    assert every["accepted"] == 40 and every["truly_wrong"] == pytest.approx(4 / 40)
    assert suggested["accepted"] >= 30 and suggested["truly_wrong"] <= 0.1
    _, out, _ = ssrvlad(*ask)
    assert "Without ground truth: 40 answers, about " in out
    assert re.search(r"Suggested threshold 0\.\d+: \d+ of 40 accepted, \w+ wrong", out)
    assert out.count("in truth 4 wrong\n") >= 1
    truth = {f"today/{number:03}": [f"town/{number:03}"] for number in range(6)}
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    _, out, _ = ssrvlad(*ask[:3], "--follow", "no", "--ground-truth", tmp_path / "truth.json")
    assert out.count("in truth 4 wrong of 6 whose truth is known") == 2
