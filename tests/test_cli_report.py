"""`ssrvlad evaluate --report`: a page beside the figures, with what pictures can be found."""

import base64
import io
import json
import re
import shutil

import numpy as np
import pytest
from drives import write_maps, write_photos, write_truth
from helpers import street, write_street
from PIL import Image
from reports import Page
from segmenting import write_photos as street_photos
from segmenting import write_settings

from ssrvlad_torch.taxonomy import colourise

CAMVID = ("--labels-as", "camvid-11")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out.html"


@pytest.fixture
def report(evaluate, out):
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


def test_a_page_comes_beside_the_figures(evaluate, report, out):
    page = report("--tolerance-frames", 0)
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


def test_only_the_file_that_was_encoded_is_shown(report, tmp_path):
    for number in range(6):
        shutil.copy(tmp_path / "tuesday" / "000.png", tmp_path / "monday" / f"{number:03d}.png")
    page = report("--tolerance-frames", 0)
    assert not any("monday" in name for name in described(page))
    (tmp_path / "monday").rename(tmp_path / "moved")
    assert report("--tolerance-frames", 0).words.count("no picture") == 4


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


def test_with_a_segmenter_photos_and_label_maps_are_shown(ssrvlad, tmp_path, out):
    for day in ("monday", "tuesday"):
        street_photos(tmp_path / day, range(4))
    network = ("--segmenter", write_settings(tmp_path))
    db = tmp_path / "photos.ssrdb"
    assert ssrvlad("encode", tmp_path / "monday", "-o", db, *CAMVID, *network)[0] == 0
    arguments = (db, tmp_path / "tuesday", *network, "--tolerance-frames", 0)
    assert ssrvlad("evaluate", *arguments, "--report", out)[0] == 0
    page = Page(out.read_text("utf-8"))
    days = {name.rpartition("/")[0] for name in described(page)}
    kinds = ("photo", "label map")
    assert days == {f"{kind} of {day}" for kind in kinds for day in ("monday", "tuesday")}
    for name in described(page):
        if name.startswith("label map"):
            assert_shows(page, name, int(name.rpartition("/")[2]))
