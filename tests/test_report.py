"""The page of an evaluation, taken apart: what it says, and that it needs nothing but itself."""

import dataclasses
import errno
import json
import os
import re
import shutil
import subprocess
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import street
from reports import Page, frame_set, noisy, report_of

from ssrvlad_torch.evaluation.metrics import CONVENTIONS, figure_rows
from ssrvlad_torch.evaluation.report import Picture, stored_scores, write_report
from ssrvlad_torch.evaluation.report.page import MATCHES_OF_A_KIND, MOST_STEPS, fraction, render
from ssrvlad_torch.files import check_output
from ssrvlad_torch.taxonomy import CATEGORIES, colourise

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def picture(frame):
    """A label map and a photo for any frame."""
    labels = street(sum(frame.encode()))
    return Picture(colourise(labels, "camvid-11"), np.stack([labels * 20] * 3, axis=2))


@pytest.fixture(scope="module")
def report():
    """Forty queries, the first right, the last wrong, some of places that are not there."""
    queries, references = noisy(40, 50, 4.0)
    truth = [[row, row + 1] if row % 8 < 7 else [] for row in range(40)]
    pictures = {"query_pictures": picture, "reference_pictures": picture}
    return report_of(queries, references, truth, notes=["2 of 42 are left out"], **pictures)


@pytest.fixture(scope="module")
def page(report):
    return Page(render(report))


def test_it_needs_no_other_file_and_no_network(report, page):
    for tag, attributes in page.tags:
        for name in ("src", "href", "srcset", "poster", "action", "data"):
            assert attributes.get(name, "#").startswith(("#", "data:")), (tag, attributes)
    html = re.sub(r"data:image/\w+;base64,[\w+/=]+", "", render(report))
    assert not re.search(r"//\w|url\((?!#)|@import|fetch\(|XMLHttpRequest", html)


def test_a_screen_reader_finds_its_way(page):
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    for _, attributes in page.tags:
        named = attributes.get("aria-labelledby", "").split() + attributes.get("for", "").split()
        if attributes.get("href", "").startswith("#"):
            named.append(attributes["href"][1:])
        assert set(named) <= set(ids)
    assert all("alt" in attributes for attributes in page.all("img"))
    assert all(attributes["scope"] in ("row", "col") for attributes in page.all("th"))
    assert all(a.get("role") == "img" or a.get("aria-hidden") for a in page.all("svg"))
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert all(b - a <= 1 for a, b in pairwise(levels))
    assert page.all("html")[0]["lang"] == "en"


def test_it_fits_a_phone_and_both_themes(page):
    metas = {a.get("name"): a.get("content") for a in page.all("meta")}
    assert metas["viewport"] == "width=device-width, initial-scale=1"
    assert metas["color-scheme"] == "light dark"
    style = next(text for around, text in page.texts if around[-1] == "style")
    for expected in ("prefers-color-scheme: dark", "max-width: 700px", "@media print"):
        assert expected in style


def test_it_tells_every_figure_with_its_interval(report, page):
    assert "40 queries, 35 of them with a true match, against 50 references." in page.words
    assert "Convention exact" in page.words
    assert "2 of 42 are left out" in page.words
    for name, value, ends in figure_rows(report.metrics):
        assert f"{name} {fraction(value)} {fraction(*ends)}" in page.words


def test_it_tells_every_threshold(report, page):
    points = report.metrics["thresholds"]
    expected = [
        ("precision 99\N{NO-BREAK SPACE}%", points["at_precision"]["0.99"]),
        ("precision 100\N{NO-BREAK SPACE}%", points["at_precision"]["1"]),
        ("recall 50\N{NO-BREAK SPACE}%", points["at_recall"]["0.5"]),
        ("suggested", points["suggested"]),
    ]
    texts = [text for around, text in page.texts if around[-1] in ("th", "td")]
    for name, point in expected:
        row = texts[texts.index(name) :][1:6]
        if point is None:
            assert row == ["none", *["\N{EN DASH}"] * 4]
        else:
            fractions = [f"{point[key]:.3f}" for key in ("precision", "precision_low", "recall")]
            assert row == [f"{point['score']:.4f}", *fractions, str(point["accepted"])]
    assert points["at_precision"]["1"]
    assert points["suggested"]


def test_the_script_gets_what_follows_from_each_threshold(report, page):
    steps = json.loads(next(t for _, t in page.texts if t.startswith('{"score"')))
    right = report.outcomes.correct
    assert steps["score"] == sorted(steps["score"])
    assert steps["accepted"] == sorted(steps["accepted"], reverse=True)
    for score, precision, recall, accepted in zip(
        *(steps[name] for name in ("score", "precision", "recall", "accepted")), strict=True
    ):
        above = report.outcomes.score >= score - 6e-6
        assert accepted == above.sum()
        assert precision == pytest.approx(right[above].mean(), abs=1e-5)
        assert recall == pytest.approx(right[above].sum() / 35, abs=1e-5)
    point = report.metrics["thresholds"]["at_precision"]["0.99"]
    assert steps["score"][steps["start"]] == pytest.approx(point["score"], abs=1e-5)


def test_matches_of_each_kind_come_with_their_pictures(report, page):
    cards = page.all("article", "match")
    assert len(cards) == 3 * MATCHES_OF_A_KIND
    assert page.words.count("✗ wrong") == 2 * MATCHES_OF_A_KIND
    assert page.words.count("✓ right") == MATCHES_OF_A_KIND
    alts = [a["alt"] for a in page.all("img")]
    wrong = ~report.outcomes.correct
    worst = np.flatnonzero(wrong)[report.outcomes.score[wrong].argmax()]
    candidate = report.references.frames[report.outcomes.candidate[worst]]
    first = alts.index(f"photo of query/{worst:04d}")
    assert alts[first : first + 4] == [
        f"photo of query/{worst:04d}",
        f"label map of query/{worst:04d}",
        f"photo of {candidate}",
        f"label map of {candidate}",
    ]
    metres = 10 * abs(int(worst) - int(report.outcomes.candidate[worst]))
    score = report.outcomes.score[worst]
    assert f"best candidate {candidate} score {score:.4f}, {metres:.1f} m away" in page.words


def test_the_true_match_stands_beside_a_wrong_one(page):
    ranks = re.findall(
        r"true match reference/\d+ rank (\d+), single-frame score \d\.\d{4} "
        r"\(best candidate \d\.\d{4}\)",
        page.words,
    )
    assert ranks
    assert all(int(rank) > 1 for rank in ranks)


def test_a_place_that_is_not_there_has_no_true_match():
    page = Page(render(report_of(*noisy(4, 4), [[]] * 4)))
    assert page.words.count("No reference shows this place") == 4
    assert "true match reference/" not in page.words
    assert "No query missed a true match." in page.words


def test_categories_only_where_descriptors_have_them(report, page):
    tables = page.all("table", "categories")
    assert len(tables) == 3 * MATCHES_OF_A_KIND
    heads = [text for around, text in page.texts if around[-2:] == ("tr", "th")]
    assert all(heads.count(category) == len(tables) for category in CATEGORIES)
    without = Page(render(dataclasses.replace(report, descriptors=None)))
    assert not without.all("table", "categories")
    assert len(without.all("article")) == len(page.all("article"))


def test_frames_without_pictures_say_so(report):
    bare = Page(render(dataclasses.replace(report, query_pictures=lambda _: Picture())))
    assert bare.words.count("no picture") == 3 * MATCHES_OF_A_KIND
    assert not [a for a in bare.all("img") if "query/" in a["alt"]]


NASTY = "<img src=x onerror=alert(1)>&amp;\"'</script>$title ${x} %s \N{SNOWMAN} 漢字"


def test_texts_are_shown_as_they_are(report):
    def renamed(frames):
        names = tuple(f"{NASTY}/{frame}" for frame in frames.frames)
        return dataclasses.replace(frames, frames=names)

    nasty = dataclasses.replace(
        report,
        title=NASTY,
        queries=renamed(report.queries),
        references=renamed(report.references),
        settings={NASTY: NASTY},
        notes=[NASTY],
        descriptors=report.descriptors._replace(parts=dict.fromkeys([NASTY, *CATEGORIES[1:]], 3)),
    )
    page, plain = Page(render(nasty)), Page(render(report))
    assert [tag for tag, _ in page.tags] == [tag for tag, _ in plain.tags]
    assert not any("onerror" in attributes for _, attributes in page.tags)
    assert page.texts.count((("html", "body", "header", "h1"), NASTY)) == 1
    assert any(NASTY in a["alt"] for a in page.all("img"))
    for around in ("dt", "dd", "li", "h4", "th"):
        assert any(NASTY in text for names, text in page.texts if names[-1] == around)


def test_a_text_that_is_no_unicode_is_no_obstacle(report, tmp_path):
    write_report(tmp_path / "out.html", dataclasses.replace(report, title="bad \udcff name"))
    assert "bad ? name" in (tmp_path / "out.html").read_text("utf-8")


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_every_convention(convention):
    queries, references = noisy(12, 14)
    report = report_of(queries, references, [[row] for row in range(12)], convention)
    page = Page(render(report))
    assert f"Convention {convention} . " in page.words
    styles = [attributes.get("style", "") for attributes in page.all("path")]
    dashed = [s for s in styles if "stroke-dasharray" in s and "var(--other)" in s]
    assert len(dashed) == (convention != "exact")


@pytest.mark.parametrize(
    ("queries", "references", "truth"),
    [
        (0, 3, lambda row: [row]),
        (1, 1, lambda row: [0]),
        (1, 1, lambda row: []),
        (5, 7, lambda row: []),
        (5, 7, lambda row: [6]),
        (3, 200, lambda row: [row]),
    ],
)
def test_few_frames(queries, references, truth):
    here, there = noisy(queries, references, 1.0)
    html = render(report_of(here, there, [truth(row) for row in range(queries)]))
    assert f"{queries} queries" in Page(html).words
    assert not re.search(r"\bnan\b|\binf\b|NaN|Infinity", html)


def test_all_frames_empty():
    empty = frame_set(torch.zeros(3, 24))
    page = Page(render(report_of(empty, empty, [[0], [1], []])))
    assert "3 queries have no candidate" in page.words
    assert not page.all("article")


def test_a_true_match_that_is_empty_matches_nothing():
    queries, references = noisy(4, 4, 0.0)
    references.descriptors[2] = 0
    page = Page(render(report_of(queries, references, [[0], [1], [2], [3]])))
    assert "true match reference/0002 not among the first 10, no score" in page.words


def test_scores_may_be_stored(report):
    rows, columns = (np.arange(len(f.frames)) for f in (report.queries, report.references))
    stored = stored_scores(report.scores(rows, columns))
    assert render(dataclasses.replace(report, scores=stored)) == render(report)


def test_its_size_is_bounded():
    queries, references = noisy(1500, 1200, length=8)
    big = report_of(queries, references, [[row % 1200] for row in range(1500)])
    html = render(big)
    assert len(html) < 1_000_000
    assert len(Page(html).all("article")) <= 3 * MATCHES_OF_A_KIND
    steps = json.loads(re.search(r'<script type="application/json" id="steps">(.*?)<', html)[1])
    assert len(steps["score"]) <= MOST_STEPS + 4


def test_a_missing_folder_is_told_beforehand(report, tmp_path):
    place = tmp_path / "none" / "out.html"
    for attempt in (lambda: check_output(place), lambda: write_report(place, report)):
        with pytest.raises(OSError, match=r"out.html: there is no folder .*none$"):
            attempt()
    with pytest.raises(OSError, match="it is a folder"):
        check_output(tmp_path)
    assert not [*tmp_path.iterdir()]


def test_a_full_disk_leaves_the_old_page(report, tmp_path, monkeypatch):
    def refuse(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    place = tmp_path / "out.html"
    place.write_text("old")
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match="No space left"):
        write_report(place, report)
    assert place.read_text() == "old"
    assert [*tmp_path.iterdir()] == [place]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_browser_runs_it(report, tmp_path):
    place = tmp_path / "out.html"
    write_report(place, report)
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    flags = [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000"]
    done = subprocess.run(
        [*command, *flags, place.as_uri()], capture_output=True, text=True, check=True
    )
    page = Page(done.stdout)
    chooser = next(a for a in page.all("div", "chooser"))
    assert "hidden" not in chooser
    point = report.metrics["thresholds"]["at_precision"]["0.99"]
    assert f"score {point['score']:.4f} and above: {point['accepted']} accepted" in page.words
    assert page.all("circle", "chosen-step")
    assert page.all("line", "chosen-step")
