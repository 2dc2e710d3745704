"""`ssrvlad evaluate`: every form of ground truth, every convention, and what cannot be used."""

import json
import re

import pytest
from helpers import write_maps, write_truth


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
