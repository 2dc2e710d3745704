"""The page of an evaluation, taken apart: what it says, that it needs nothing but itself, and
`ssrvlad evaluate --report`."""

import base64
import dataclasses
import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from html.parser import HTMLParser
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
import torch
from helpers import descriptors, street, write_maps, write_photos, write_street, write_truth
from PIL import Image

from ssrvlad_torch.database.frames import FrameSet
from ssrvlad_torch.datasets.image_files import Pixels
from ssrvlad_torch.evaluation.measure import Evaluation, Recognition, measure
from ssrvlad_torch.evaluation.metrics import Convention, figure_rows, fraction
from ssrvlad_torch.evaluation.report import render, write_report
from ssrvlad_torch.recognition.matching import match
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.taxonomy import colourise

VOID = {"meta", "link", "img", "input", "br"}


def frame_set(vectors: torch.Tensor, sequence: str = "drive") -> FrameSet:
    """Frames of one sequence, ten metres apart on a line."""
    count = len(vectors)
    poses = np.stack([np.arange(count) * 10.0, np.zeros(count), np.zeros(count)], 1)
    return FrameSet(
        frames=tuple(f"{sequence}/{row:04d}" for row in range(count)),
        sequences=(sequence,) * count,
        channels={"descriptor": vectors},
        poses=poses,
        stamps=np.full(count, np.nan),
        empty=~vectors.any(dim=1).numpy(),
    )


def noisy(queries: int, references: int, noise: float = 2.0, seed: int = 0, length: int = 24):
    """Queries and references; query n looks like reference n, the more noise the less."""
    there = descriptors(seed, references, length)
    here = there[torch.arange(queries) % max(references, 1)] if references else there[:0]
    wander = descriptors(seed + 1, len(here), length)
    amount = torch.linspace(0, noise, len(here))[:, None]
    return frame_set(here + amount * wander, "query"), frame_set(there, "reference")


class Drawn(NamedTuple):
    """The material of a report: the cosines of all pairs, and pictures of any frame."""

    pairs: npt.NDArray[np.float32]
    query: Callable[[str], Mapping[str, Pixels]] = lambda _: {}

    def of_queries(self, queries):
        return self._replace(pairs=self.pairs[queries])

    def cosines(self, queries, references):
        return self.pairs[np.ix_(queries, references)]

    def reference(self, frame):
        return self.query(frame)


def evaluation_of(
    queries: FrameSet,
    references: FrameSet,
    truth: Sequence[Sequence[int]],
    convention: Convention = "exact",
    pictures: Callable[[str], Mapping[str, Pixels]] = lambda _: {},
) -> Evaluation:
    """Matching by cosine, measured."""
    pairs = score(queries.descriptors, references.descriptors).numpy()
    matches = match(queries.descriptors, references.descriptors, 10)
    truth = [np.array(rows, np.int64) for rows in truth]
    recognition = Recognition(references, queries, matches, Drawn(pairs, pictures))
    return measure(recognition, truth, convention)


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
    assert f"best candidate {candidate} score {score:.4g}, {metres:.1f} m away" in page.words
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
    rows = [truth(row) for row in range(queries)]
    found = evaluation_of(here, there, rows, convention="vpr-bench")
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
