"""`ssrvlad evaluate`: every form of ground truth, every convention, and what cannot be used."""

from __future__ import annotations

import json

import numpy as np
import pytest
from drawings import VOID
from drives import vpr_bench, write_maps, write_truth
from PIL import Image


def test_queries_that_are_in_the_database_are_mentioned(ssrvlad, database, maps):
    code, _, err = ssrvlad("evaluate", database, maps, "--tolerance-frames", 1)
    assert code == 0
    assert err == ["ssrvlad: 6 of 6 queries are in the database themselves"]


def test_odd_against_even_frames(ssrvlad, maps, tmp_path):
    db = tmp_path / "even.ssrdb"
    ssrvlad("encode", maps, "-o", db, "--labels-as", "camvid-11", "--every", 2)
    code, out, err = ssrvlad(
        "evaluate", db, maps, "--every", 2, "--start", 1, "--tolerance-frames", 1, "--json"
    )
    assert (code, err) == (0, [])
    assert (json.loads(out)["references"], json.loads(out)["queries"]) == (3, 3)


@pytest.fixture
def evaluate(ssrvlad, database, tmp_path):
    """Evaluates six frames of Tuesday, alike those of Monday, against Monday's database."""
    tuesday = write_maps(tmp_path / "tuesday", range(6))

    def run(*arguments: object) -> tuple[int, str, list[str]]:
        return ssrvlad("evaluate", database, tuesday, "--temporal", 0, *arguments)

    return run


def test_evaluate_names_its_convention_and_gives_intervals_and_thresholds(evaluate):
    code, out, err = evaluate("--tolerance-frames", 0, "--json")
    metrics = json.loads(out)
    assert (code, err) == (0, [])
    assert metrics["convention"] == "exact"
    figures = ("auc_pr", "average_precision", "recall_at_100_precision", "extended_precision")
    assert [metrics[name] for name in figures] == [1.0] * 4
    assert metrics["intervals"]["recall_at"]["1"] == metrics["intervals"]["auc_pr"] == [1.0, 1.0]
    assert metrics["roc_auc"] is None
    assert metrics["intervals"]["roc_auc"] == [None, None]
    points = metrics["thresholds"]
    assert points["at_precision"]["1"]["accepted"] == 6
    assert points["at_recall"]["0.5"]["precision"] == 1.0
    assert points["suggested"]["accepted"] == 6 and points["suggested"]["precision_low"] < 0.95


def test_evaluate_prints_all_figures(evaluate):
    code, out, _ = evaluate("--tolerance-frames", 0, "--at-recall", 0.25)
    assert code == 0
    for words in ("exact", "average precision", "ROC-AUC", "1.000 to 1.000", "recall 0.25"):
        assert words in out
    assert "suggested" in out


@pytest.mark.parametrize("convention", ["vpr-bench", "vpr-tutorial", "vpr-tutorial-single"])
def test_other_conventions(evaluate, convention):
    out = evaluate("--tolerance-frames", 1, "--convention", convention, "--json")[1]
    metrics = json.loads(out)
    assert metrics["convention"] == convention
    assert 0 < metrics["auc_pr"] <= 1
    assert (metrics["average_precision"] is None) == convention.startswith("vpr-tutorial")
    assert convention in evaluate("--tolerance-frames", 1, "--convention", convention)[1]


def test_an_empty_frame_is_no_obstacle_to_any_convention(evaluate, tmp_path):
    Image.fromarray(np.full((24, 32), VOID, np.uint8)).save(tmp_path / "tuesday" / "003.png")
    for convention in ("exact", "vpr-bench", "vpr-tutorial", "vpr-tutorial-single"):
        out = evaluate("--tolerance-frames", 0, "--convention", convention, "--json")[1]
        metrics = json.loads(out)
        assert metrics["recall_at"]["1"] == pytest.approx(5 / 6)
        assert metrics["auc_pr"] > 0.1


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("truth.json", {f"tuesday/{n:03d}": [f"monday/{n:03d}"] for n in range(6)}),
        ("truth.json", [[f"tuesday/{n:03d}", f"monday/{n:03d}"] for n in range(6)]),
        (
            "truth.csv",
            "query,reference\n" + "".join(f"tuesday/{n:03d},monday/{n:03d}\n" for n in range(6)),
        ),
        ("truth.csv", "\n".join(",".join(str(int(a == b)) for a in range(6)) for b in range(6))),
        ("truth.npy", np.eye(6)),
        ("ground_truth_new.npy", vpr_bench([[n] for n in range(6)])),
    ],
)
def test_every_form_of_ground_truth(evaluate, tmp_path, name, content):
    code, out, err = evaluate("--ground-truth", write_truth(tmp_path / name, content), "--json")
    assert (code, err) == (0, [])
    assert json.loads(out)["recall_at"]["1"] == 1.0


def test_queries_without_ground_truth_are_left_out_and_counted(evaluate, tmp_path):
    truth = {"tuesday/001": ["monday/001"], "tuesday/004": []}
    path = write_truth(tmp_path / "truth.json", truth)
    code, out, err = evaluate("--ground-truth", path, "--json")
    assert code == 0
    assert err == [f"ssrvlad: 4 of 6 queries are left out: {path} does not name them"]
    metrics = json.loads(out)
    assert (metrics["queries"], metrics["queries_with_match"]) == (2, 1)
    assert metrics["recall_at"]["1"] == 1.0


@pytest.mark.parametrize("how", ["frames", "matrix"])
def test_a_skipped_query_keeps_its_place(evaluate, tmp_path, how):
    """What counts frames counts the unreadable one, too."""
    (tmp_path / "tuesday" / "002.png").write_text("no image")
    truth = write_truth(tmp_path / "truth.npy", np.eye(6))
    arguments = {"frames": ("--tolerance-frames", 0), "matrix": ("--ground-truth", truth)}[how]
    code, out, err = evaluate(*arguments, "--json")
    assert code == 3
    assert len(err) == 1
    metrics = json.loads(out)
    assert (metrics["queries"], metrics["recall_at"]["1"]) == (5, 1.0)


def test_headings_can_count(ssrvlad, tmp_path):
    city, db = tmp_path / "city", tmp_path / "city.ssrdb"
    ssrvlad("city", city, "--frames", 8, "--seed", 1)
    ssrvlad("encode", city / "reference", "-o", db, "--labels-as", "cityscapes-trainids")
    counts = []
    for degrees in (None, 180, 0):
        limit = [] if degrees is None else ["--tolerance-degrees", degrees]
        arguments = ("evaluate", db, city / "query", "--tolerance-metres", 5, *limit, "--json")
        counts.append(json.loads(ssrvlad(*arguments)[1])["queries_with_match"])
    assert counts == [8, 8, 0]


class Code:
    """A pickle of it calls a function."""

    def __reduce__(self):
        return print, ("run",)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", vpr_bench([[0]] * 5 + [[6]]), "names reference 6 of query 5; the database has 6"),
        ("a.npy", vpr_bench([[0]] * 5), "has 5 rows, expected one for each of 6 queries"),
        ("a.npy", vpr_bench([Code()] * 6), "it asks for builtins.print"),
        ("a.npy", np.eye(6, 5), "is a matrix of shape (6, 5), expected (6, 6)"),
        ("a.json", {"tuesday/000": ["monday/6"]}, "names reference 'monday/6', which is not in"),
        ("a.txt", "", "a.txt: expected a file in .json, .csv, .npy, .npz"),
    ],
)
def test_bad_ground_truth_is_one_line(evaluate, tmp_path, name, content, message):
    code, out, err = evaluate("--ground-truth", write_truth(tmp_path / name, content))
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]


def test_all_queries_skipped(ssrvlad, database, tmp_path):
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.png").write_text("no image")
    code, out, err = ssrvlad(
        "evaluate", database, tmp_path / "bad", "--tolerance-frames", 1, "--json"
    )
    assert code == 3
    assert json.loads(out)["recall_at"]["1"] is None
    assert len(err) == 1
