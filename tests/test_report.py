"""The page of an evaluation, taken apart: what it says, that it needs nothing but itself, and
`ssrvlad evaluate --report`."""

import base64
import dataclasses
import io
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import street, write_maps, write_photos, write_street, write_truth
from PIL import Image

from ssrvlad_torch import Map
from ssrvlad_torch.evaluation.measure import Evaluation
from ssrvlad_torch.evaluation.metrics import figure_rows, fraction
from ssrvlad_torch.evaluation.report import render, write_report
from ssrvlad_torch.recognition.recognise import Steps
from ssrvlad_torch.taxonomy import colourise

VOID = {"meta", "link", "img", "input", "br"}


class Page(HTMLParser):
    """A page taken apart; elements that are not closed where they should be are an error.

    Attributes:
        tags: ``(name, attributes)`` in order.
        texts: ``(names of the elements around, text)`` in order, without blank ones.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[tuple[tuple[str, ...], str]] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag, f"{tag} closed inside another element"

    def handle_data(self, data):
        if data.strip():
            self.texts.append((tuple(self._open), data))

    def all(self, tag: str, kind: str | None = None) -> list[dict[str, str]]:
        """Attributes of the elements of a name, and of a class."""
        found = (attributes for name, attributes in self.tags if name == tag)
        return [a for a in found if kind is None or kind in a.get("class", "").split()]

    @property
    def words(self) -> str:
        """All that is read, in order."""
        shown = (text for around, text in self.texts if not {"style", "script"} & {*around})
        return " ".join(" ".join(shown).split())


def page_of(evaluation: Evaluation, title="town", settings=None, notes=()) -> Page:
    """The page of an evaluation."""
    return Page(render(evaluation, title, settings or {}, notes))


def evaluated(folder, queries, references, truth, **settings):
    """The evaluation of label maps, ten metres apart on a line, in a map of others. Queries from
    the number 30 on are of no place of the map."""
    write_maps(folder / "reference", range(references))
    for number in range(queries):
        seed = number if number < 30 else 100 + number
        write_street(folder / "query" / f"{number:03d}.png", seed)
    drives = ("query", queries), ("reference", references)
    rows = [f"{drive}/{n:03d},{10 * n},0\n" for drive, count in drives for n in range(count)]
    (folder / "poses.csv").write_text("frame,x,y\n" + "".join(rows))
    content = {
        f"query/{n:03d}": [f"reference/{row:03d}" for row in truth(n)] for n in range(queries)
    }
    file = write_truth(folder / "truth.json", content)
    town = Map.open(folder / "town", labels_as="camvid-11")
    town.add(folder / "reference")
    return town.evaluate(folder / "query", Steps(follow=None), ground_truth=file, **settings)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Forty queries, the last of them wrong, and some of places that are not there."""
    folder = tmp_path_factory.mktemp("report")
    return evaluated(folder, 40, 50, lambda row: [row, row + 1] if row % 8 < 7 else [])


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
            assert row == [f"{point['threshold']:.4g}", *fractions, str(point["accepted"])]


def test_matches_come_with_their_pictures(report, page):
    alts = [a["alt"] for a in page.all("img") if " of " in a["alt"] and "/" in a["alt"]]
    wrong, sure = ~report.outcomes.correct, report.ranked.score
    worst = np.flatnonzero(wrong)[sure[wrong].argmax()]
    candidate = report.recognition.references.frames[report.outcomes.candidate[worst]]
    assert alts[:2] == [f"label map of query/{worst:03d}", f"label map of {candidate}"]
    metres = 10 * abs(int(worst) - int(report.outcomes.candidate[worst]))
    words = f"{report.metrics['threshold_is']} {sure[worst]:.4g}, {metres:.1f} m away"
    assert f"best candidate {candidate} {words}" in page.words
    ranks = re.findall(r"true match reference/\d+ rank (\d+)", page.words)
    assert ranks
    assert all(int(rank) > 1 for rank in ranks)


def test_matches_come_first_after_a_map_where_there_are_poses(report, page):
    titles = [text for around, text in page.texts if around[-1] == "h2"]
    assert titles == ["Matches", "Figures", "Threshold", "Precision against recall", "Settings"]
    assert page.all("img")[0]["alt"].startswith("Queries from above")
    unplaced = dataclasses.replace(
        report.recognition.queries, poses=np.full_like(report.recognition.queries.poses, np.nan)
    )
    recognition = dataclasses.replace(report.recognition, queries=unplaced)
    alts = [
        a["alt"] for a in page_of(dataclasses.replace(report, recognition=recognition)).all("img")
    ]
    assert alts and not any(alt.startswith("Queries from above") for alt in alts)


NASTY = "<img src=x onerror=alert(1)>&amp;\"'</script>$title ${x} %s \N{SNOWMAN} 漢字"


def test_texts_are_shown_as_they_are(report, page, tmp_path):
    def renamed(frames):
        names = tuple(f"{NASTY}/{frame}" for frame in frames.frames)
        return dataclasses.replace(frames, frames=names)

    sides = {name: renamed(getattr(report.recognition, name)) for name in ("queries", "references")}
    pictures = {"label map": np.zeros((4, 5, 3), np.uint8)}
    cosines = report.recognition.material.cosines
    sides["material"] = SimpleNamespace(
        query=lambda _: pictures, reference=lambda _: pictures, cosines=cosines
    )
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


@pytest.mark.parametrize(
    ("queries", "references", "truth"),
    [
        (1, 1, lambda row: [0]),
        (1, 1, lambda row: []),
        (5, 7, lambda row: []),
        (5, 7, lambda row: [6]),
    ],
)
def test_a_page_of_few_frames_is_written(queries, references, truth, tmp_path):
    found = evaluated(tmp_path, queries, references, truth, convention="vpr-bench")
    html = without_images(render(found, "town", {}))
    assert f"{queries} queries" in Page(html).words and "Convention vpr-bench" in Page(html).words
    assert not re.search(r"\bnan\b|\binf\b|NaN|Infinity", html)


CAMVID = ("--labels-as", "camvid-11")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.html"


@pytest.fixture
def written(evaluate, out):
    """The page of an evaluation."""

    def run(*arguments: object) -> Page:
        code, _, err = evaluate("--report", out, *arguments)
        assert (code, err) == (0, [])
        return Page(out.read_text("utf-8"))

    return run


def shown(page: Page, what: str) -> np.ndarray:
    """The picture with a description."""
    address = next(a["src"] for a in page.all("img") if a["alt"] == what)
    content = base64.b64decode(address.partition("base64,")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def described(page: Page) -> set[str]:
    return {a["alt"] for a in page.all("img") if re.match("photo|label map", a["alt"])}


def assert_shows(page: Page, what: str, seed: int) -> None:
    """Expects that the picture with a description is the label map of a seed."""
    np.testing.assert_array_equal(shown(page, what), colourise(street(seed), "camvid-11"))


def test_a_page_comes_beside_the_figures(evaluate, written, out):
    page = written("--tolerance-frames", 0)
    for words in (
        "6 queries, 6 of them with a true match, against 6 references.",
        "/tuesday against town.ssrdb ",
        "true matches at most 0 frames away",
        "preset default",
    ):
        assert words in page.words
    assert "steps standardised, sweep" in page.words or "steps not standardised" in page.words
    days = {name[:-4] for name in described(page)}
    assert days == {"label map of monday", "label map of tuesday"}
    assert len(described(page)) == 8
    for picture in described(page):
        assert_shows(page, picture, int(picture[-3:]))

    near, page = ("--tolerance-frames", 1), ("--report", out)
    plain, reported = (evaluate(*near, *rest)[1] for rest in ((), page))
    assert reported == f"{plain}report: {out}\n"
    metrics = json.loads(evaluate(*near, "--json")[1])
    assert json.loads(evaluate(*near, "--json", *page)[1]) == metrics
    page = Page(out.read_text("utf-8"))
    assert f"fingerprint {metrics['fingerprint']}" in page.words
    low, high = metrics["intervals"]["auc_pr"]
    assert f"AUC-PR {metrics['auc_pr']:.3f} {low:.3f} to {high:.3f}" in page.words


def test_the_page_counts_queries_that_were_left_out_or_skipped(evaluate, tmp_path, out):
    truth = {f"tuesday/{n:03d}": [f"monday/{n:03d}"] for n in (0, 2, 3)}
    (tmp_path / "tuesday" / "005.png").write_text("no image")
    truth = write_truth(tmp_path / "truth.json", truth)
    code, _, err = evaluate("--report", out, "--ground-truth", truth)
    assert (code, len(err)) == (3, 2)
    page = Page(out.read_text("utf-8"))
    assert "3 queries, 3 of them with a true match" in page.words
    assert "2 of 5 queries are left out: no true matches are known" in page.words
    assert "1 more queries were skipped, the first is tuesday/005: " in page.words
    assert {"label map of tuesday/002", "label map of tuesday/003"} <= described(page)


@pytest.mark.parametrize("predicted", [False, True])
def test_a_data_set_has_photos_too(ssrvlad, tmp_path, out, predicted):
    """Queries with a network's label maps against references with the data set's own, CamVid."""
    drive, folder = tmp_path / "camvid", tmp_path / "camvid" / "0016E5"
    write_maps(folder / "labels", range(8))
    for number in range(8):
        write_street(folder / "predicted" / f"{number:03d}.png", number + 1)
    write_photos(folder / "images", range(8), ".jpg")
    db, layout = tmp_path / "drive.ssrdb", ("--layout", "camvid", "--every", 2)
    assert ssrvlad("encode", drive, "-o", db, *layout)[0] == 0
    labels = ("--labels", "predicted", *CAMVID) if predicted else ()
    code, _, err = ssrvlad("evaluate", db, drive, *layout, "--start", 1, *labels, "--report", out)
    assert (code, err) == (0, [])
    page = Page(out.read_text("utf-8"))
    assert "no picture" not in page.words
    frames = {name.partition(" of ")[2] for name in described(page)}
    assert {int(frame[-3:]) % 2 for frame in frames} == {0, 1}
    for frame in frames:
        number = int(frame[-3:])
        assert_shows(page, f"label map of {frame}", number + (predicted and number % 2))
        image = Image.open(folder / "images" / f"{number:03d}.jpg")
        difference = np.abs(np.asarray(image, int) - shown(page, f"photo of {frame}"))
        assert difference.mean() < 12
