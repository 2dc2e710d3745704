"""The reduced similarity matrix, held to the whole one, and its pictures."""

import base64
import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from reports import Page, frame_set, noisy, report_of

from ssrvlad_torch.evaluation.report import images, similarity
from ssrvlad_torch.evaluation.report.images import (
    label_uri,
    mask_uri,
    photo_uri,
    scores_uri,
)
from ssrvlad_torch.evaluation.report.page import render
from ssrvlad_torch.evaluation.report.similarity import similarity_matrix
from ssrvlad_torch.recognition.matching import match


def pixels(address: str) -> np.ndarray:
    content = base64.b64decode(address.partition("base64,")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (40, 60), (23, 61)])
@pytest.mark.parametrize("blocks", [(1, 1), (3, 8), (100, 100)])
@pytest.mark.parametrize("most", [(4, 6), (100, 100)])
def test_cells_are_the_highest_of_their_pairs(monkeypatch, shape, blocks, most):
    monkeypatch.setattr(similarity, "_QUERY_BLOCK", blocks[0])
    monkeypatch.setattr(similarity, "_REFERENCE_BLOCK", blocks[1])
    queries, references = noisy(*shape, 3.0)
    queries.descriptors[shape[0] // 2] = 0
    references.descriptors[0] = 0
    truth = [[row % shape[1], (5 * row) % shape[1]] if row % 3 else [] for row in range(shape[0])]
    report = report_of(queries, references, truth)
    got = similarity_matrix(report.scores, shape[1], report.outcomes, report.truth, most)
    whole = match(queries.descriptors, references.descriptors, top=shape[1])
    pairs = np.full(shape, -np.inf, np.float32)
    for row, (scores, columns) in enumerate(zip(*(m.numpy() for m in whole), strict=True)):
        pairs[row, columns[columns >= 0]] = scores[columns >= 0]
    true, right, wrong = np.zeros((3, *shape), bool)
    for row, columns in enumerate(truth):
        true[row, columns] = True
        taken = report.outcomes.candidate[row]
        if taken >= 0:
            (right if taken in columns else wrong)[row, taken] = True
    assert got.scores.shape == tuple(min(pair) for pair in zip(shape, most, strict=True))
    assert (got.rows[-1], got.columns[-1]) == shape
    for y in range(len(got.rows) - 1):
        for x in range(len(got.columns) - 1):
            cell = np.s_[got.rows[y] : got.rows[y + 1], got.columns[x] : got.columns[x + 1]]
            assert pairs[cell].size > 0
            assert got.scores[y, x] == pytest.approx(pairs[cell].max(), abs=1e-6)
            marks = (got.truth[y, x], got.right[y, x], got.wrong[y, x])
            assert marks == (true[cell].any(), right[cell].any(), wrong[cell].any())


def test_scores_become_gray_levels():
    scores = np.array([[-np.inf, 0.25], [0.5, 0.75]], np.float32)
    picture = pixels(scores_uri(scores))
    assert tuple(picture[0, 1, :3]) == images.DARKEST
    assert tuple(picture[1, 1, :3]) == images.LIGHTEST
    middle = (np.array(images.DARKEST) + np.array(images.LIGHTEST)) / 2
    np.testing.assert_allclose(picture[1, 0, :3], middle, atol=1)
    assert len({tuple(colour) for colour in picture.reshape(-1, 4)}) == 4
    for flat in (np.full((2, 2), 0.3, np.float32), np.full((1, 1), -np.inf, np.float32)):
        assert pixels(scores_uri(flat)).shape == (*flat.shape, 4)


def test_masks_are_transparent_where_nothing_is_marked():
    wrong, right = np.array([[1, 1, 0]], bool), np.array([[0, 1, 0]], bool)
    picture = pixels(mask_uri([(wrong, (9, 8, 7)), (right, (1, 2, 3))]))
    assert picture[0].tolist()[:2] == [[9, 8, 7, 255], [1, 2, 3, 255]]
    assert picture[0, 2, 3] == 0


def test_pictures_are_reduced_and_small_ones_kept():
    small = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    np.testing.assert_array_equal(pixels(label_uri(small))[..., :3], small)
    large = np.zeros((1024, 2048, 3), np.uint8)
    large[:, 1000:1002] = 255
    reduced = pixels(label_uri(large))
    assert reduced.shape[:2] == (200, 400)
    assert reduced[..., :3].max() > 50, "a thin pole stays"
    assert pixels(photo_uri(large)).shape == reduced.shape
    assert photo_uri(large).startswith("data:image/jpeg;base64,/9j/")


def test_the_figure_shows_the_matrix_and_names_sequences():
    queries, references = noisy(6, 9)
    frames = frame_set(references.descriptors, "monday").frames[:5]
    named = frame_set(references.descriptors, "tuesday <b>")
    named = dataclasses.replace(named, frames=(*frames, *named.frames[5:]))
    report = report_of(queries, named, [[row] for row in range(6)])
    page = Page(render(report))
    cells, truth, taken = (pixels(a["src"]) for a in page.all("img")[:3])
    assert cells.shape == truth.shape == taken.shape == (6, 9, 4)
    np.testing.assert_array_equal(truth[..., 3] > 0, np.eye(6, 9, dtype=bool))
    assert ((taken[..., 3] > 0).sum(1) == 1).all()
    widths = {a["title"]: a["style"] for a in page.all("span") if "title" in a}
    assert widths["monday: 5 frames"] == "flex:5"
    assert widths["tuesday <b>: 4 frames"] == "flex:4"
    assert "score of a pair" in page.words


def test_the_figure_says_what_a_cell_stands_for():
    queries, references = noisy(10, 850, length=8)
    report = report_of(queries, references, [[]] * 10)
    page = Page(render(report))
    assert "up to 1 by 2 pairs" in page.words
    assert pixels(page.all("img")[0]["src"]).shape[:2] == (10, 800)
