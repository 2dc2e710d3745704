"""Charts of the page: what is drawn is what was measured, to a hundredth of a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reports import Page, noisy, report_of

from ssrvlad_torch.evaluation.metrics import precision_recall_curve
from ssrvlad_torch.evaluation.report.charts import (
    HEIGHT,
    WIDTH,
    Axis,
    Plane,
    linear_axis,
    thinned,
)
from ssrvlad_torch.evaluation.report.plots import precision_recall_plot, recall_plot, score_plot
from ssrvlad_torch.evaluation.report.recall import recall_rates

UNIT = Plane(Axis("x", 0, 1, (0, 1)), Axis("y", 0, 1, (0, 1)))


@pytest.fixture(scope="module")
def report():
    queries, references = noisy(60, 70, 4.0)
    return report_of(queries, references, [[row] if row % 6 else [] for row in range(60)])


def values(page, number=0, kind=None):
    """The points of a line, from pixels back to values."""
    svg, line = page.all("svg", "chart")[0], page.all("polyline", kind)[number]
    x_low, x_high, y_low, y_high = map(float, svg["data-ends"].split())
    left, right, top, bottom = map(float, svg["data-frame"].split())
    x, y = np.array([pair.split(",") for pair in line["points"].split()], float).T
    return (
        x_low + (x - left) / (right - left) * (x_high - x_low),
        y_low + (bottom - y) / (bottom - top) * (y_high - y_low),
    )


def test_precision_and_recall_lie_where_they_should(report):
    points = report.metrics["thresholds"]
    page = Page(precision_recall_plot(report.curve, report.curve, "exact", points))
    recall, precision = values(page)
    assert (recall[0], precision[0]) == pytest.approx((0, report.curve.precision[0]), abs=1e-4)
    drawn = np.stack((recall, precision), 1)[1:]
    curve = np.stack((report.curve.recall, report.curve.precision), 1)
    distance = np.abs(drawn[:, None] - curve).max(axis=2)
    assert distance.min(axis=1).max() < 1e-4, "every point that is drawn is one of the curve"
    for x, y in curve:
        near = drawn[np.abs(drawn[:, 0] - x) < 2 / WIDTH, 1]
        assert near.min() - 1e-4 <= y <= near.max() + 1e-4, "every point of the curve is covered"


def test_the_convention_is_drawn_beside_the_exact_one(report):
    other = precision_recall_curve(report.outcomes, report.truth, "vpr-bench")
    points = report.metrics["thresholds"]
    page = Page(precision_recall_plot(other, report.curve, "vpr-bench", points))
    assert values(page, kind="chosen")[0][-1] == pytest.approx(1)
    assert values(page, kind="other")[0][-1] == pytest.approx(report.curve.recall[-1], abs=1e-4)


def test_recall_rates_lie_where_they_should(report):
    rates = recall_rates(report.outcomes, 10)
    page = Page(recall_plot(rates))
    share, rate = values(page)
    n = 10 ** ((share - 1) / 9)
    np.testing.assert_allclose(n, np.arange(1, 11), rtol=1e-3)
    np.testing.assert_allclose(rate, rates.rate, atol=1e-4)
    assert page.all("polygon", "band")


def test_bars_count_the_best_candidates(report):
    page = Page(score_plot(report.outcomes, report.metrics["thresholds"]))
    svg = page.all("svg")[0]
    low, high = map(float, svg["data-ends"].split()[2:])
    top, bottom = map(float, svg["data-frame"].split()[2:])
    right, known = report.outcomes.correct, report.outcomes.has_match
    wanted = {"right": right.sum(), "wrong": (~right & known).sum(), "unknown": (~known).sum()}
    assert min(wanted.values()) > 0
    for kind, count in wanted.items():
        heights = [float(bar["height"]) for bar in page.all("rect", kind)]
        assert sum(heights) * (high - low) / (bottom - top) == pytest.approx(count, abs=0.1)
        assert f"({count})" in page.words


lines = st.lists(st.tuples(st.floats(0, WIDTH - 1), st.floats(0, HEIGHT)), max_size=60)


@given(lines, st.integers(1, 40))
def test_a_thinned_line_covers_the_same_pixels(points, columns):
    x, y = np.array(sorted(points), np.float64).reshape(-1, 2).T
    few_x, few_y = thinned(x, y, columns)
    assert len(few_x) <= 4 * columns
    assert set(zip(few_x, few_y, strict=True)) <= set(zip(x, y, strict=True))
    column, few = np.floor(x * columns / WIDTH), np.floor(few_x * columns / WIDTH)
    for place in set(column):
        every, kept = y[column == place], few_y[few == place]
        assert (kept[0], kept[-1]) == (every[0], every[-1])
        assert (kept.min(), kept.max()) == (every.min(), every.max())


@given(st.floats(-1e3, 1e3), st.floats(0, 1e3), st.booleans())
def test_ticks_are_round_and_inside(low, width, whole):
    axis = linear_axis("x", low, low + width, whole)
    assert axis.low < axis.high
    slack = 1e-6 * (axis.high - axis.low)
    assert all(axis.low - slack <= tick <= axis.high + slack for tick in axis.ticks)
    assert len(axis.ticks) <= 9
    steps = np.diff(axis.ticks)
    np.testing.assert_allclose(steps, steps[:1].repeat(len(steps)), rtol=1e-6, atol=1e-9)
    assert not whole or all(tick == round(tick) for tick in axis.ticks)


def test_axes_by_hand():
    assert linear_axis("x", 0, 1).ticks == (0, 0.2, 0.4, 0.6, 0.8, 1)
    assert linear_axis("x", -7, 19, whole=True).ticks == (-5, 0, 5, 10, 15)
    assert linear_axis("x", 0, 1, whole=True).ticks == (0, 1)
    halfway = Axis("n", 1, 100, (), logarithmic=True).share([1, 10, 100])
    np.testing.assert_allclose(halfway, [0, 0.5, 1])
    assert UNIT.across(0) < UNIT.across(1)
    assert UNIT.down(0) > UNIT.down(1)
