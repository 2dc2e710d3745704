"""Coarse forms of descriptors against the scores that they stand for."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import descriptors, grids

from ssrvlad_torch import native
from ssrvlad_torch.channels import Column
from ssrvlad_torch.channels import coarse as module
from ssrvlad_torch.channels.coarse import LANES, CoarseSigns, CoarseVectors, learn, of
from ssrvlad_torch.recognition.recognise import references_of
from ssrvlad_torch.recognition.sweep import score


def by_signs(queries, rows, sweep=True):
    town = references_of({"features": rows}, [""] * len(rows))
    return torch.from_numpy(town.compare({"features": queries.numpy()}, sweep=sweep)[0])


@pytest.mark.parametrize("shape", [(8, 3, 4), (5, 3, 9), (1, 2, 1), (16, 16, 16)])
@pytest.mark.parametrize("count", [1, 130])
def test_coarse_signs_are_scored_as_signs_of_two_bytes_a_cell(library, shape, count):
    """Also where bits fill up the words of a column."""
    rows, queries = grids(count, shape), grids(3, shape, 1)
    form = CoarseSigns(Column("features", "", shape, "uint8"))
    codes = form.codes(rows)
    assert len(codes) == count and codes.shape[2] % 8 == 0
    every = max(1, shape[2] // 2)
    some = [each[..., ::every].contiguous() for each in (queries, rows)]
    expected = by_signs(*some)
    got = form.scan([*queries], codes, count)
    torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)
    if form.layers > 1:
        more = [each[..., every // 2 :: every] for each in (queries, rows)]
        both = [torch.cat(parts, -1).contiguous() for parts in zip(some, more, strict=True)]
        whole = np.concatenate((codes, form.codes(rows, 1)), 2)
        finer = by_signs(*both)
        got = form.scan([*queries], whole, count)
        torch.testing.assert_close(got, finer, atol=1e-5, rtol=0)
    expected = by_signs(*some, sweep=False)
    got = form.scan([*queries], codes, count, sweep=False)
    torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("anchors", [None, 3])
@pytest.mark.parametrize("count", [1, 64, 130])
def test_coarse_vectors_of_few_directions_are_nearly_exact(library, anchors, count):
    """Vectors that lie in 20 dimensions; of a sweep the best anchor counts."""
    inside, mean = torch.linalg.qr(descriptors(0, 90, 20))[0], descriptors(3, 1, 90)
    rows = 2 * F.normalize(descriptors(1, count, 20) @ inside.T + mean, dim=1)
    shape = (4, anchors) if anchors else (4,)
    queries = descriptors(2, 4 * (anchors or 1), 20) @ inside.T
    queries = queries.view(*shape, 90)
    form = CoarseVectors.learn(F.normalize(descriptors(4, 500, 20) @ inside.T + mean, dim=1))
    codes = form.codes(rows)
    assert codes.dtype == np.int8 and len(codes) == -(-count // LANES)
    got = form.scan([*queries], codes, count)
    torch.testing.assert_close(got, score(queries, rows), atol=0.03, rtol=0)
    usual = queries[:, 1] if anchors else queries
    got = form.scan([*queries], codes, count, sweep=False)
    torch.testing.assert_close(got, score(usual, rows), atol=0.03, rtol=0)


def test_what_was_learnt_makes_the_same_codes():
    vectors, column = descriptors(0, 300, 40), Column("hog", "", (40,))
    form = learn(column, vectors)
    again = of(column, form.learnt)
    assert np.array_equal(form.codes(vectors), again.codes(vectors))
    assert np.abs(form.codes(vectors)).max() > 50, "the range of a number is used"
    signs = Column("features", "", (8, 3, 4), "uint8")
    assert learn(signs, grids(2, (8, 3, 4))).learnt == {} == of(signs, {}).learnt


def test_both_libraries_give_the_same_scores(monkeypatch):
    if native.core().library is None:
        pytest.skip("needs the native core")
    vectors = descriptors(0, 200, 100)
    form = CoarseVectors.learn(vectors)
    scanned = form.scan([*vectors[:3]], form.codes(vectors), 200)
    monkeypatch.setattr(module, "core", lambda: native.Core(None, "none"))
    again = form.scan([*vectors[:3]], form.codes(vectors), 200)
    torch.testing.assert_close(scanned, again, atol=1e-5, rtol=0)
