"""`ssrvlad evaluate`: every form of ground truth, every convention, and what cannot be used."""

import json

import numpy as np
import pytest
from drawings import SPACE, VOID
from drives import write_maps, write_truth
from helpers import street
from PIL import Image


def test_queries_that_are_in_the_database_are_mentioned(ssrvlad, database, maps):
    code, _, err = ssrvlad("evaluate", database, maps, "--tolerance-frames", 1)
    assert code == 0
    assert err == ["ssrvlad: 6 of 6 queries have ids of the database"]


def test_a_folder_of_the_same_name_is_another_drive(ssrvlad, database, tmp_path):
    """Its frames are named by time, as those of an aligned drive that was later."""
    other = write_maps(tmp_path / "other" / "monday", range(6))
    for path in sorted(other.iterdir()):
        path.rename(path.with_stem(f"1{path.stem}"))
    code, out, err = ssrvlad("evaluate", database, other, "--tolerance-frames", 0, "--json")
    assert (code, err) == (0, [])
    assert json.loads(out)["recall_at"]["1"] == 1


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


def test_a_ground_truth_says_as_much_of_a_path_as_it_likes(ssrvlad, database, tmp_path):
    """The ids of queries depend on what else is asked; what their paths end in does not."""
    dusk, night = (write_maps(tmp_path / t / "tuesday", range(6)) for t in ("dusk", "night"))
    for end in ("tuesday", "dusk/tuesday", f"{tmp_path.name}/dusk/tuesday"):
        truth = write_truth(tmp_path / "t.json", {f"{end}/003": ["monday/003"]})
        options = ("--ground-truth", truth, "--json")
        for queries in ([dusk], [dusk, night]):
            code, out, err = ssrvlad("evaluate", database, *queries, *options)
            if end == "tuesday" and len(queries) > 1:
                assert (
                    code == 2
                    and "dusk/tuesday/003 or" in err[-1]
                    and "night/tuesday/003" in err[-1]
                )
            else:
                assert (code, json.loads(out)["queries"]) == (0, 1)


def test_evaluate_prints_all_figures(evaluate):
    code, out, _ = evaluate("--tolerance-frames", 0, "--at-recall", 0.25)
    assert code == 0
    for words in ("exact", "average precision", "ROC-AUC", "1.000 to 1.000", "recall 0.25"):
        assert words in out
    assert "suggested" in out


def test_every_convention_with_an_empty_frame(evaluate, tmp_path):
    Image.fromarray(np.full((24, 32), VOID, np.uint8)).save(tmp_path / "tuesday" / "003.png")
    for convention in ("exact", "vpr-bench", "vpr-tutorial", "vpr-tutorial-single"):
        arguments = ("--tolerance-frames", 0, "--convention", convention)
        metrics = json.loads(evaluate(*arguments, "--json")[1])
        assert metrics["convention"] == convention
        assert metrics["recall_at"]["1"] == pytest.approx(5 / 6)
        assert 0.1 < metrics["auc_pr"] <= 1
        assert (metrics["average_precision"] is None) == convention.startswith("vpr-tutorial")
    assert convention in evaluate(*arguments)[1]


def test_queries_without_ground_truth_are_left_out_and_counted(evaluate, tmp_path):
    truth = {"tuesday/001": ["monday/001"], "tuesday/004": []}
    path = write_truth(tmp_path / "truth.json", truth)
    code, out, err = evaluate("--ground-truth", path, "--json")
    assert code == 0
    assert err == [f"ssrvlad: 4 of 6 queries are left out: {path} does not name them"]
    metrics = json.loads(out)
    assert (metrics["queries"], metrics["queries_with_match"]) == (2, 1)
    assert metrics["recall_at"]["1"] == 1.0


def test_queries_of_the_ground_truth_that_are_not_there_are_counted(evaluate, tmp_path):
    truth = {f"tuesday/{n}": ["monday/001"] for n in ("001", "10", "9")}
    path = write_truth(tmp_path / "truth.json", truth)
    _, _, err = evaluate("--ground-truth", path)
    strange = f"2 queries of {path} do not exist, the first is tuesday/9"
    assert f"ssrvlad: {strange}" in err


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


def test_the_estimate_stands_beside_the_truth(ssrvlad, tmp_path):
    """Forty streets; four queries have the labels of another one."""
    streets = [street(seed) for seed in range(40)]
    for name, maps in (("town", streets), ("today", streets[4:5] * 4 + streets[4:])):
        (tmp_path / name).mkdir()
        for number, labels in enumerate(maps):
            np.save(tmp_path / name / f"{number:03}.npy", labels)
    town = tmp_path / "town.ssrdb"
    assert ssrvlad("encode", tmp_path / "town", "-o", town, "--labels-as", SPACE)[0] == 0
    ask = "evaluate", town, tmp_path / "today", "--tolerance-frames", 0, "--follow", "no"
    code, out, _ = ssrvlad(*ask, "--json")
    found = json.loads(out)["estimates"]
    assert code == 0 and list(found) == ["accepted", "suggested_without_truth"]
    for each in found.values():
        assert each["accepted"] == 40 and each["wrong"] == pytest.approx(1 / 40)
        assert each["truly_wrong"] == pytest.approx(4 / 40) and each["low"] <= 0.1 <= each["high"]
    _, out, _ = ssrvlad(*ask)
    assert "without ground truth: no decoy beats 40 answers; 2.5% estimated to be wrong" in out
    assert "suggested without ground truth: accepted 40 answers of confidence" in out
    assert out.count("in truth 10.0%") == 2
