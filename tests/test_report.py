"""The page of an evaluation, taken apart: what it says, and that it needs nothing but itself."""

import dataclasses
import re
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import street
from matplotlib.figure import Figure
from reports import Drawn, Page, evaluation_of, frame_set, noisy, page_of

from ssrvlad_torch.evaluation import report as evaluation_report
from ssrvlad_torch.evaluation.metrics import figure_rows, fraction
from ssrvlad_torch.evaluation.outcomes import judge
from ssrvlad_torch.evaluation.report import (
    RIGHT_MATCHES,
    WRONG_MATCHES,
    Match,
    chosen_matches,
    reduced_cosines,
    render,
    score_groups,
    write_report,
)
from ssrvlad_torch.taxonomy import colourise


def pictures(frame):
    """A label map and a photo for any frame."""
    labels = street(sum(frame.encode()))
    return {
        "photo": np.stack([labels * 20] * 3, axis=2),
        "label map": colourise(labels, "camvid-11"),
    }


@pytest.fixture(scope="module")
def report():
    """Forty queries, the first right, the last wrong, some of places that are not there."""
    queries, references = noisy(40, 50, 4.0)
    truth = [[row, row + 1] if row % 8 < 7 else [] for row in range(40)]
    return evaluation_of(queries, references, truth, pictures=pictures)


@pytest.fixture(scope="module")
def html(report):
    return render(report, "town", {"preset": "default"}, ["2 of 42 are left out"])


@pytest.fixture(scope="module")
def page(html):
    return Page(html)


def without_images(html):
    return re.sub(r"data:image/\w+;base64,[\w+/=]+", "", html)


def test_the_page_needs_no_other_file_and_no_network(html, page):
    for tag, attributes in page.tags:
        for name in ("src", "href", "srcset", "poster", "action", "data"):
            assert attributes.get(name, "#").startswith(("#", "data:")), (tag, attributes)
    html = without_images(html)
    assert not re.search(r"//\w|url\((?!#)|@import|<script", html)
    assert all(attributes["alt"] for attributes in page.all("img"))
    assert all(attributes["scope"] in ("row", "col") for attributes in page.all("th"))
    assert page.all("html")[0]["lang"] == "en"


@pytest.mark.parametrize("name", ["_precision_recall", "_scores", "_matrix"])
def test_no_legend_covers_what_is_drawn(report, name):
    figure = Figure(figsize=(6, 4.2), layout="constrained")
    axes = figure.add_subplot()
    getattr(evaluation_report, name)(axes, report)
    figure.draw_without_rendering()
    (legend,) = [*figure.legends, *filter(None, [axes.get_legend()])]
    assert not legend.get_window_extent().overlaps(axes.get_window_extent())
    assert figure.bbox.x0 <= legend.get_window_extent().x0
    assert legend.get_window_extent().x1 <= figure.bbox.x1


def test_the_page_has_every_figure_and_threshold(report, page):
    assert "40 queries, 35 of them with a true match, against 50 references." in page.words
    assert "Convention exact" in page.words
    assert "2 of 42 are left out" in page.words
    for name, value, ends in figure_rows(report.metrics):
        assert f"{name} {fraction(value)} {fraction(*ends)}" in page.words
    points = report.metrics["thresholds"]
    assert points["suggested"]
    texts = [text for around, text in page.texts if around[-1] in ("th", "td")]
    for name, point in (
        ("precision 0.99", points["at_precision"]["0.99"]),
        ("precision 1", points["at_precision"]["1"]),
        ("recall 0.5", points["at_recall"]["0.5"]),
        ("suggested", points["suggested"]),
    ):
        row = texts[texts.index(name) :][1:6]
        if point is None:
            assert row == ["none", *["-"] * 4]
        else:
            fractions = [f"{point[key]:.3f}" for key in ("precision", "precision_low", "recall")]
            assert row == [f"{point['score']:.4f}", *fractions, str(point["accepted"])]


def test_scores_have_the_name_of_what_they_are(report):
    metrics = {**report.metrics, "score_is": "probability"}
    page = page_of(dataclasses.replace(report, metrics=metrics))
    assert "best candidates whose probability is at least the threshold" in page.words
    assert re.search(r"best candidate reference/\d+ probability \d\.\d{4}", page.words)


def test_matches_come_with_their_pictures(report, page):
    alts = [a["alt"] for a in page.all("img") if " of " in a["alt"] and "/" in a["alt"]]
    wrong = ~report.outcomes.correct
    worst = np.flatnonzero(wrong)[report.outcomes.score[wrong].argmax()]
    candidate = report.recognition.references.frames[report.outcomes.candidate[worst]]
    assert alts[:4] == [
        f"photo of query/{worst:04d}",
        f"label map of query/{worst:04d}",
        f"photo of {candidate}",
        f"label map of {candidate}",
    ]
    metres = 10 * abs(int(worst) - int(report.outcomes.candidate[worst]))
    score = report.outcomes.score[worst]
    assert f"best candidate {candidate} score {score:.4f}, {metres:.1f} m away" in page.words
    ranks = re.findall(r"true match reference/\d+ rank (\d+)", page.words)
    assert ranks
    assert all(int(rank) > 1 for rank in ranks)


SIMILARITY = np.array(
    [
        [0.9, 0.1, 0.2, 0.0],  # right
        [0.8, 0.7, 0.1, 0.0],  # wrong, two true matches
        [0.6, 0.5, 0.1, 0.2],  # wrong
        [0.0, 0.0, 0.0, 0.95],  # the place is not there
        [0.3, 0.99, 0.0, 0.0],  # right
        [-np.inf] * 4,  # no candidate
        [0.6, 0.5, 0.1, 0.2],  # like the third
    ]
)
TRUTH = [np.array(rows, np.int64) for rows in ([0, 3], [2, 1], [2], [], [1], [0], [2])]


@pytest.fixture
def outcomes():
    order = np.argsort(-SIMILARITY, axis=1, kind="stable")
    scores = np.take_along_axis(SIMILARITY, order, 1)
    return judge(scores, np.where(np.isneginf(scores), -1, order), TRUTH)


def test_the_surest_matches_come_first(outcomes):
    wrong, right = chosen_matches(outcomes, TRUTH, Drawn(SIMILARITY))
    assert wrong == [Match(3, 3, -1), Match(1, 0, 1), Match(2, 0, 2), Match(6, 0, 2)]
    assert right == [Match(4, 1, 1), Match(0, 0, 0)]
    many = dataclasses.replace(outcomes, **{
        f.name: np.tile(getattr(outcomes, f.name), 9) for f in dataclasses.fields(outcomes)
    })  # fmt: skip
    kinds = chosen_matches(many, TRUTH * 9, Drawn(np.tile(SIMILARITY, (9, 1))))
    assert [len(kind) for kind in kinds] == [WRONG_MATCHES, RIGHT_MATCHES]


def test_scores_are_grouped_by_what_became_of_the_query(outcomes):
    groups = {name: sorted(scores.tolist()) for name, scores in score_groups(outcomes).items()}
    assert groups == {
        "right": [0.9, 0.99],
        "wrong": [0.6, 0.6, 0.8],
        "wrong, place not in the database": [0.95],
    }


@pytest.mark.parametrize("most", [(1, 1), (2, 3), (5, 2), (9, 9)])
def test_a_cell_of_the_matrix_is_its_highest_cosine(most):
    cells = reduced_cosines(Drawn(SIMILARITY), 7, 4, most)
    counts = zip((7, 4), most, strict=True)
    rows, columns = (np.linspace(0, n, min(n, m) + 1).astype(int) for n, m in counts)
    expected = [
        [SIMILARITY[a:b, c:d].max() for c, d in pairwise(columns)] for a, b in pairwise(rows)
    ]
    np.testing.assert_array_equal(cells, np.float32(expected))


def test_a_place_that_is_not_there_has_no_true_match_and_an_empty_frame_no_candidate():
    page = page_of(evaluation_of(*noisy(4, 4), [[]] * 4))
    assert page.words.count("No reference shows this place") == 4
    assert "true match reference/" not in page.words
    assert "No best candidate is right." in page.words
    empty = frame_set(torch.zeros(3, 24))
    page = page_of(evaluation_of(empty, empty, [[0]] * 3))
    assert "3 queries have no candidate" in page.words


NASTY = "<img src=x onerror=alert(1)>&amp;\"'</script>$title ${x} %s \N{SNOWMAN} 漢字"


def test_texts_are_shown_as_they_are(report, page, tmp_path):
    def renamed(frames):
        names = tuple(f"{NASTY}/{frame}" for frame in frames.frames)
        return dataclasses.replace(frames, frames=names)

    sides = {name: renamed(getattr(report.recognition, name)) for name in ("queries", "references")}
    nasty = dataclasses.replace(
        report, recognition=dataclasses.replace(report.recognition, **sides)
    )
    shown = page_of(nasty, NASTY, {NASTY: NASTY}, [NASTY])
    assert [tag for tag, _ in shown.tags] == [tag for tag, _ in page.tags]
    assert not any("onerror" in attributes for _, attributes in shown.tags)
    assert shown.texts.count((("html", "body", "h1"), NASTY)) == 1
    assert any(NASTY in a["alt"] for a in shown.all("img"))
    for around in ("dt", "dd", "li", "td"):
        assert any(NASTY in text for names, text in shown.texts if names[-1] == around)
    write_report(tmp_path / "out.html", "bad \udcff name")
    assert "bad ? name" in (tmp_path / "out.html").read_text("utf-8")


@pytest.mark.parametrize("convention", ["exact", "vpr-bench"])
def test_every_convention_makes_a_page(convention):
    queries, references = noisy(12, 14)
    found = evaluation_of(queries, references, [[row] for row in range(12)], convention)
    assert f"Convention {convention} . " in page_of(found).words


@pytest.mark.parametrize(
    ("queries", "references", "truth"),
    [
        (0, 3, lambda row: [row]),
        (1, 1, lambda row: [0]),
        (1, 1, lambda row: []),
        (5, 7, lambda row: []),
        (5, 7, lambda row: [6]),
        (3, 900, lambda row: [row]),
    ],
)
def test_a_page_of_few_frames_is_written(queries, references, truth):
    here, there = noisy(queries, references, 1.0)
    found = evaluation_of(here, there, [truth(row) for row in range(queries)])
    html = without_images(render(found, "town", {}))
    assert f"{queries} queries" in Page(html).words
    assert not re.search(r"\bnan\b|\binf\b|NaN|Infinity", html)
