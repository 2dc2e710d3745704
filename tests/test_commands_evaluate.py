"""`ssrvlad evaluate`: every form of ground truth, every convention, and what cannot be used."""

import json
import re

import numpy as np
import pytest
from drawings import SPACE, VOID
from helpers import write_maps, write_street, write_truth
from PIL import Image


def test_a_note_counts_queries_that_are_in_the_database(ssrvlad, database, maps):
    """The database may be a URI."""
    for town in (database, f"file://{database}"):
        code, _, err = ssrvlad("evaluate", town, maps, "--tolerance-frames", 1)
        assert (code, err) == (0, ["ssrvlad: 6 of 6 queries have ids of the database"])


def test_evaluate_names_its_convention_and_gives_intervals_and_thresholds(evaluate):
    code, out, err = evaluate("--tolerance-frames", 0, "--json")
    metrics = json.loads(out)
    assert (code, err) == (0, [])
    assert metrics["convention"] == "exact"
    figures = ("auc_pr", "average_precision", "recall_at_100_precision", "extended_precision")
    assert [metrics[name] for name in figures] == [1.0] * 4
    assert metrics["intervals"]["recall_at"]["1"] == pytest.approx([0.610, 1.0], abs=1e-3)
    assert metrics["intervals"]["auc_pr"] == [1.0, 1.0]
    assert metrics["roc_auc"] is None
    assert metrics["intervals"]["roc_auc"] == [None, None]
    points = metrics["thresholds"]
    assert points["at_precision"]["1"]["accepted"] == 6
    assert points["at_recall"]["0.5"]["precision"] == 1.0
    assert points["suggested"]["accepted"] == 6 and points["suggested"]["precision_low"] < 0.95

    code, out, _ = evaluate("--tolerance-frames", 0)
    assert code == 0
    for words in ("exact", "average precision", "ROC-AUC", "0.610 to 1.000", "recall 0.5"):
        assert words in out
    words = "6 of 6 accepted, none wrong (precision at least 61 %)"
    assert re.search(rf"Suggested threshold of the \w+ 0\.\d+: {re.escape(words)}\n", out)
    assert "needs 73 accepted queries" in evaluate("--tolerance-frames", 0, "--verbose")[1]


def test_a_ground_truth_names_frames_by_any_end_of_their_paths(ssrvlad, database, tmp_path):
    """The ids of queries depend on what else is asked; what their paths end in does not."""
    dusk, night = (write_maps(tmp_path / t / "tuesday", range(6)) for t in ("dusk", "night"))
    for end in ("tuesday", "dusk/tuesday", f"{tmp_path.name}/dusk/tuesday"):
        truth = write_truth(tmp_path / "t.json", {f"{end}/003": ["monday/003"]})
        options = ("--ground-truth", truth, "--json")
        for queries in ([dusk], [dusk, night]):
            code, out, err = ssrvlad("evaluate", database, *queries, *options)
            if end == "tuesday" and len(queries) > 1:
                words = ("dusk/tuesday/003 or", "night/tuesday/003")
                assert code == 2 and all(word in err[-1] for word in words)
            else:
                assert (code, json.loads(out)["queries"]) == (0, 1)


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
