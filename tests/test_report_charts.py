"""Charts of the page: what is drawn is what was measured, and the script can find its place."""

import dataclasses
import re

import numpy as np
import pytest
from reports import Page, noisy, report_of

from ssrvlad_torch.evaluation.metrics import precision_recall_curve
from ssrvlad_torch.evaluation.outcomes import judge
from ssrvlad_torch.evaluation.report.charts import (
    HEIGHT,
    WIDTH,
    map_chart,
    precision_recall_chart,
    recall_chart,
    score_chart,
)
from ssrvlad_torch.evaluation.report.page import operating_rows
from ssrvlad_torch.evaluation.report.recall import recall_rates
from ssrvlad_torch.recognition.matching import match


@pytest.fixture(scope="module")
def report():
    queries, references = noisy(60, 70, 4.0)
    return report_of(queries, references, [[row] if row % 6 else [] for row in range(60)])


def paths(svg, variable):
    """The points of the paths in a colour of the page, from pixels back to values."""
    root = Page(svg).all("svg", "chart")[0]
    assert root["viewbox"] == f"0 0 {WIDTH} {HEIGHT}"
    x_low, x_high, y_low, y_high = map(float, root["data-ends"].split())
    left, right, top, bottom = map(float, root["data-frame"].split())
    found = []
    for path in Page(svg).all("path"):
        if f"var(--{variable})" in path.get("style", "") and path.get("clip-path"):
            x, y = np.array(re.findall(r"[ML] (\S+) (\S+)", path["d"]), float).T
            x = x_low + (x - left) / (right - left) * (x_high - x_low)
            found.append((x, y_low + (bottom - y) / (bottom - top) * (y_high - y_low)))
    return found


def test_precision_and_recall_lie_where_they_should(report):
    points = dict(operating_rows(report.metrics["thresholds"]))
    svg = precision_recall_chart(report.curve, report.curve, "exact", points)
    ((recall, precision),) = paths(svg, "chosen")
    assert (recall[0], precision[0]) == pytest.approx((0, report.curve.precision[0]), abs=1e-3)
    distance = np.abs(recall[:, None] - report.curve.recall) + np.abs(
        precision[:, None] - report.curve.precision
    )
    assert distance[1:].min(axis=1).max() < 2e-3, "every point that is drawn is one of the curve"


def test_the_convention_is_drawn_beside_the_exact_one(report):
    other = precision_recall_curve(report.outcomes, report.truth, "vpr-bench")
    svg = precision_recall_chart(other, report.curve, "vpr-bench", {})
    assert paths(svg, "chosen")[0][0][-1] == pytest.approx(1, abs=1e-3)
    assert paths(svg, "other")[0][0][-1] == pytest.approx(report.curve.recall[-1], abs=1e-3)


def test_recall_rates_lie_where_they_should(report):
    rates = recall_rates(report.outcomes, 10)
    drawn = next(rate for _, rate in paths(recall_chart(rates), "chosen") if len(rate) <= 10)
    assert drawn[0] == pytest.approx(rates.rate[0], abs=1e-3)
    assert drawn[-1] == pytest.approx(rates.rate[-1], abs=1e-3)


def test_bars_count_the_best_candidates(report):
    svg = score_chart(report.outcomes, None)
    right, known = report.outcomes.correct, report.outcomes.has_match
    expected = {"right": right.sum(), "wrong": (~right & known).sum(), "unknown": (~known).sum()}
    assert min(expected.values()) > 0
    for kind, count in expected.items():
        heights = [y.max() - y.min() for _, y in paths(svg, kind)]
        assert sum(heights) == pytest.approx(count, abs=0.1)


def test_two_charts_share_no_id(report):
    rates = recall_rates(report.outcomes, 10)
    both = Page(recall_chart(rates) + score_chart(report.outcomes, None))
    ids = [attributes["id"] for _, attributes in both.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_the_map_shows_right_and_wrong_queries():
    """Two drives of references side by side, never joined; a line leads to what was wrong."""
    queries, references = noisy(6, 6, 0.0)
    references = dataclasses.replace(
        references, frames=tuple(f"{'ab'[row // 3]}/{row}" for row in range(6))
    )
    truth = [np.array([row if row < 4 else 0]) for row in range(6)]
    outcomes = judge(
        *(best.numpy() for best in match(queries.descriptors, references.descriptors)), truth
    )
    svg = str(map_chart(queries.poses, references, outcomes))
    assert "right: 4; wrong: 2; wrong, place not in the database: 0." in svg
    drawn = re.findall(r'd="([^"]+)"[^>]*stroke: var\(--other\)', svg)
    assert len(drawn) == 2
    assert "var(--right)" in svg and "var(--wrong)" in svg
    nowhere = np.full((6, 3), np.nan)
    assert map_chart(nowhere, references, outcomes) is None
    assert (
        map_chart(queries.poses, dataclasses.replace(references, poses=nowhere), outcomes) is None
    )
