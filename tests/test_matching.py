"""Matching against plain NumPy."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch.recognition import matching
from ssrvlad_torch.recognition.matching import match


def coarse_vectors(seed, count):
    """Vectors of four numbers +-1 among zeros, so that every cosine is exact and ties abound; some
    are zero."""
    rng = np.random.default_rng(seed)
    vectors = np.zeros((count, 8), np.float32)
    for vector in vectors:
        if rng.random() > 0.1:
            vector[rng.choice(8, 4, replace=False)] = rng.choice([-1, 1], 4)
    return vectors


def brute_force(queries, references, top, threshold):
    """Cosines by NumPy, sorted by falling score, then by index."""
    wanted_scores = np.full((len(queries), top), -np.inf, np.float32)
    wanted_indices = np.full((len(queries), top), -1)
    for row, query in enumerate(queries):
        candidates = []
        for index, reference in enumerate(references):
            if query.any() and reference.any():
                cosine = query @ reference / np.linalg.norm(query) / np.linalg.norm(reference)
                if threshold is None or cosine > threshold:
                    candidates.append((-cosine, index))
        for place, (score, index) in enumerate(sorted(candidates)[:top]):
            wanted_scores[row, place], wanted_indices[row, place] = -score, index
    return wanted_scores, wanted_indices


@given(
    st.integers(0, 9),
    st.integers(0, 60),
    st.integers(1, 12),
    st.sampled_from([None, -0.5, 0.0, 0.25, 1.0]),
    st.integers(0, 2**32 - 1),
)
@example(9, 60, 12, None, 3)  # empty images, opposite vectors and ties
@example(3, 0, 2, None, 0)  # no references
@example(0, 5, 2, None, 0)  # no queries
@example(9, 60, 12, 0.25, 3)  # a score equal to the threshold is left out
def test_match_equals_brute_force(query_count, reference_count, top, threshold, seed):
    queries = coarse_vectors(seed, query_count)
    references = coarse_vectors(seed + 1, reference_count)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "_QUERY_BLOCK", 4)
        patch.setattr(matching, "_REFERENCE_BLOCK", 7)
        matches = match(queries, references, top, threshold)
    scores, indices = brute_force(queries, references, top, threshold)
    np.testing.assert_array_equal(matches.indices.numpy(), indices)
    np.testing.assert_array_equal(matches.scores.numpy(), scores)


def test_blocks_do_not_show_on_real_numbers(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    queries = torch.randn(30, 48, generator=generator)
    references = torch.randn(200, 48, generator=generator)
    scores, indices = match(queries, references, top=7)
    monkeypatch.setattr(matching, "_QUERY_BLOCK", 11)
    monkeypatch.setattr(matching, "_REFERENCE_BLOCK", 13)
    blockwise = match(queries, references, top=7)
    assert torch.equal(blockwise.indices, indices)
    torch.testing.assert_close(blockwise.scores, scores, rtol=0, atol=1e-6)
    exact = (
        F.cosine_similarity(queries[:, None].double(), references.double(), dim=2).topk(7).values
    )
    torch.testing.assert_close(scores.double(), exact, rtol=0, atol=1e-6)


def test_half_precision_and_excluded_references():
    generator = torch.Generator().manual_seed(1)
    queries = torch.randn(48, 70, generator=generator).T  # not contiguous
    references = torch.randn(250, 48, generator=generator).half()
    queries[5], references[3] = 0, 0
    excluded = torch.rand(70, 250, generator=generator) < 0.3
    matches = match(queries, references, 250, 0.1, excluded).indices
    scores = F.cosine_similarity(queries[:, None], references.float(), dim=2)
    expected = (scores > 0.1) & ~excluded & (queries.any(1)[:, None] & references.any(1))
    assert [set(row[row >= 0].tolist()) for row in matches] == [
        set(row.nonzero()[:, 0].tolist()) for row in expected
    ]


def test_arrays_and_doubles_are_taken():
    matches = match(np.eye(3), np.eye(3), top=1)  # type: ignore[arg-type]
    assert matches.indices[:, 0].tolist() == [0, 1, 2]
    assert matches.scores.dtype == torch.float32
    matches = match(np.eye(3), np.eye(3), 1, excluded=np.eye(3) > 0)  # type: ignore[arg-type]
    assert matches.indices[:, 0].tolist() == [1, 0, 0]


ONES = torch.ones(1, 3)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"queries": torch.zeros(2, 4)}, r"width D, got \(2, 4\) and \(3, 3\)"),
        ({"queries": torch.zeros(3)}, r"got \(3,\)"),
        ({"top": 0}, "top must be an integer from 1, got 0"),
        ({"top": 2.5}, "top must be an integer from 1, got 2.5"),
        ({"top": True}, "top must be an integer from 1, got True"),
        ({"top": 2**70}, "top must be at most 2147483647, got 11805916"),
        ({"top": "2"}, "top must be an integer from 1, got '2'"),
        ({"threshold": math.nan}, "threshold: expected a number, got nan"),
        ({"queries": torch.eye(3) * torch.nan}, "queries hold values that are not finite"),
        ({"references": torch.full((2, 3), torch.inf)}, "references hold values"),
        ({"queries": None}, "expected queries as a tensor or an array, got NoneType"),
        ({"queries": "abc"}, "expected queries as a tensor or an array, got str"),
        ({"queries": ONES.to(torch.complex64)}, "of real numbers in memory, got torch.complex64"),
        ({"queries": ONES.to("meta")}, "of real numbers in memory, .* on meta"),
        ({"queries": ONES.to_sparse()}, "of real numbers in memory, .*sparse"),
        ({"queries": 1e-30 * ONES}, "too small for float32"),
    ],
)
def test_wrong_arguments_are_refused(wrong, message):
    arguments = {"queries": torch.eye(3), "references": torch.eye(3), **wrong}
    with pytest.raises(ValueError, match=message):
        match(**arguments)
