import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import refuses
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch.recognition import matching
from ssrvlad_torch.recognition.matching import match
from ssrvlad_torch.recognition.recognise import (
    AS_PAPER,
    Steps,
    recognise,
    recognise_by_scores,
    references_of,
    runs,
)
from ssrvlad_torch.recognition.sequences import sharing
from ssrvlad_torch.recognition.sweep import COLUMNS, score
from ssrvlad_torch.recognition.temporal import temporal_sum


def two_sequences(
    rows: int, noise: float, common: float = 2.0, near: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """Each frame looks like the ``near - 1`` before it."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(rows + near - 1, 64, generator=generator).unfold(0, near, 1).sum(-1)
    places /= near**0.5
    sequences = []
    for _ in range(2):
        shared = common * torch.randn(64, generator=generator)
        apart = noise * torch.randn(rows, 64, generator=generator)
        sequences.append(F.normalize(places + shared + apart, dim=1))
    return tuple(sequences)


def by_vectors(queries, references, query_names, names, *steps, **options):
    """What is recognised by one channel of vectors."""
    town = references_of({"x": references}, names)
    return recognise({"x": queries}, query_names, town, *steps, **options)


def whole(queries: torch.Tensor, references: torch.Tensor, *steps, **options):
    """What is recognised of one sequence of queries in a map of one sequence."""
    names = ["q"] * len(queries), ["r"] * len(references)
    return by_vectors(queries, references, *names, *steps, **options)


def right(answers, rows: torch.Tensor | None = None) -> float:
    """The fraction of the queries whose first candidate is their row, or their own number."""
    first = answers.matches.indices[:, 0]
    return (first == (torch.arange(len(first)) if rows is None else rows)).float().mean().item()


def test_each_step_finds_more():
    queries, references = two_sequences(80, 1.6)
    rates = [
        right(whole(queries, references, steps))
        for steps in (AS_PAPER, Steps(follow=None), Steps())
    ]
    assert rates == sorted(rates) and rates[0] < 0.9 * rates[-1] and rates[-1] > 0.97


def test_a_few_queries_have_no_mean_of_their_own():
    """Anchors of one picture have nearly all in common, which is where it was taken."""
    queries, references = two_sequences(80, 0.8, common=0.0)
    swept = F.normalize(queries[:, None] + 0.1 * torch.randn(80, len(COLUMNS), 64), dim=2)
    alone = [whole(query[None], references) for query in swept]
    answers = torch.stack([answer.matches.indices[0, 0] for answer in alone])
    assert (answers == torch.arange(80)).float().mean() > 0.9
    assert alone[0].used["standardise"] == {"q": False}
    assert whole(swept, references).used["standardise"] == {"q": True}


def test_a_map_in_small_folders_is_searched_as_one_that_is_whole():
    """Folders of two frames would have v and -v after their own means are subtracted."""
    queries, references = two_sequences(80, 0.8)
    for names in (["r"] * 80, [f"{row // 2:02d}" for row in range(80)]):
        assert right(by_vectors(queries, references, ["q"] * 80, names, Steps(follow=None))) > 0.95


ORDER = torch.arange(80)
SHUFFLED = torch.randperm(80, generator=torch.Generator().manual_seed(0))
FOLDERS = [f"{row // 5:02d}" for row in range(80)]


@pytest.mark.parametrize(
    ("order", "names", "likeness"),
    [(SHUFFLED, ["r"] * 80, {}), (ORDER, FOLDERS, {"common": 0.0, "near": 8})],
)
def test_queries_that_are_no_sequence_are_judged_one_by_one(order, names, likeness):
    """Shuffled ones, and those of a map in folders too short to be followed."""
    queries, references = two_sequences(80, 0.8, **likeness)
    answers, alone = (
        by_vectors(queries[order], references, ["q"] * 80, names, Steps(follow=follow))
        for follow in ("offline", None)
    )
    assert answers.used["follow"] == {"q": "no, following is no surer"}
    assert torch.equal(answers.matches.indices, alone.matches.indices)
    assert right(answers, order) > 0.6


@pytest.mark.parametrize("steps", [Steps(), AS_PAPER])
def test_excluded_references_and_those_that_are_not_allowed_are_no_candidates(steps):
    queries, references = two_sequences(30, 0.3)
    allowed, excluded = np.arange(30) % 7 != 3, np.arange(30)[:, None] + [0, 1]
    masks = {"allowed": allowed, "excluded": excluded}
    indices = whole(queries, references, steps, 3, **masks).matches.indices
    assert set(indices.unique().tolist()) <= {-1, *np.flatnonzero(allowed).tolist()}
    assert not (indices == torch.arange(30)[:, None]).any()


REFUSED = {
    "expected a sequence for each of 4 queries, got 1": {"query_names": ["a"]},
    "x: expected a row for each of 3 frames, got 4": {"names": ["b"] * 3},
    "top must be at most 2147483647": {"top": 2**70},
    r"allowed: expected shape \(4,\), got \(1,\)": {"allowed": np.ones(1, bool)},
    r"excluded: expected shape \(4, 2\), got \(4,\)": {"excluded": np.zeros(4, int)},
    "expected .* of real numbers in memory": {"queries": torch.eye(4) * 1j},
    r"x: expected \(Q, 13, D\) for columns .* got \(4, 5, 4\)": {"queries": torch.ones(4, 5, 4)},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_does_not_fit_is_refused(message):
    usual = {"queries": torch.eye(4), "references": torch.eye(4)}
    names = {"query_names": ["a"] * 4, "names": ["b"] * 4}
    refuses(message, lambda: by_vectors(**{**usual, **names, **REFUSED[message]}))


def test_a_map_need_not_stand_together_to_judge_queries_alone():
    scores = torch.rand(30, 60, generator=torch.Generator().manual_seed(0))
    mixed, alone = ["a", "b"] * 30, Steps(follow=None)
    answers = recognise_by_scores(scores, ["q"] * 30, mixed, alone)
    assert answers.matches.indices[:, 0].tolist() == scores.argmax(1).tolist()
    refuses("frames of 'a' together", recognise_by_scores, scores, ["q"] * 30, mixed)


@pytest.mark.parametrize("delay", [1.5, math.nan, True, -1, "1", None])
def test_a_delay_is_a_number_of_queries(delay):
    refuses(f"delay must be an integer from 0, got {delay!r}", Steps, follow="online", delay=delay)
    refuses("expected 0, or more with follow online, got 2 with off", Steps, delay=2)
    assert Steps(follow="online", delay=np.int64(2)) == Steps(follow="online", delay=2)


# ---- the sweep: scores of the best anchor, and how wide it is


def test_a_reference_scores_its_best_anchor():
    swept = F.normalize(torch.randn(5, 3, 8), dim=2)
    references = F.normalize(torch.randn(7, 8), dim=1)
    swept[4], references[6] = 0, 0
    expected = torch.einsum("qsd,rd->qsr", swept, references).amax(1)
    expected[4], expected[:, 6] = -torch.inf, -torch.inf
    torch.testing.assert_close(score(swept, references), expected)
    torch.testing.assert_close(
        score(swept[:, 1], references)[:4, :6], (swept[:4, 1] @ references[:6].T)
    )


# ---- standardise: which traverses share a mean


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([40, 50], {(0,): (0,), (1,): (1,)}),
        ([40, 4], {(0,): (0,), (1,): (0, 1)}),
        ([20, 20, 40], {(0, 1): (0, 1), (2,): (2,)}),
        ([5, 40, 29, 1], {(0,): (0, 1, 2, 3), (1,): (1,), (2, 3): (2, 3)}),
        ([2, 27], {}),
        ([], {}),
    ],
)
def test_short_traverses_share_a_mean_with_their_neighbours_or_all(frames, expected):
    assert sharing(frames) == expected


def test_the_rows_of_each_sequence_are_a_range():
    assert list(runs(["a", "a", "b"])) == [range(0, 2), range(2, 3)]
    assert list(runs([])) == []


def test_frames_that_do_not_stand_together_are_refused():
    refuses("frames of 'a' together, got some at 2", list, runs(["a", "b", "a"]))


# ---- the temporal sum (Eq. 3) against a loop


def plain_temporal_sum(descriptors, sequences, reach):
    """Eq. 3 frame by frame."""
    summed = np.zeros_like(descriptors)
    for i in range(len(descriptors)):
        if not descriptors[i].any():
            continue
        for j in range(max(0, i - reach), min(len(descriptors), i + reach + 1)):
            if sequences[j] == sequences[i]:
                summed[i] += descriptors[j]
        length = np.linalg.norm(summed[i])
        summed[i] = summed[i] / length if length else 0
    return summed


@given(st.lists(st.integers(0, 6), max_size=4), st.integers(0, 9), st.integers(0, 2**32 - 1))
@example([3], 100, 0)  # a reach beyond the sequence
@example([6, 6, 6], 2, 1)  # empty frames among others
def test_temporal_sum_equals_a_loop(lengths, reach, seed):
    rng = np.random.default_rng(seed)
    sequences = [f"sequence {9 - s}" for s, length in enumerate(lengths) for _ in range(length)]
    descriptors = rng.uniform(0.1, 1, (len(sequences), 5)).astype(np.float32)
    descriptors[rng.random(len(sequences)) < 0.2] = 0
    before = descriptors.copy()
    summed = temporal_sum(descriptors, sequences, reach)
    np.testing.assert_array_equal(descriptors, before)
    expected = plain_temporal_sum(descriptors.astype(np.float64), sequences, reach)
    np.testing.assert_allclose(summed.numpy(), expected, rtol=0, atol=1e-6)
    assert summed.dtype == torch.float32


# ---- matching against plain NumPy


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
        for place, (falling, index) in enumerate(sorted(candidates)[:top]):
            wanted_scores[row, place], wanted_indices[row, place] = -falling, index
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
    refuses(message, match, **arguments)


# ---- what notebooks show of candidates


def test_candidates_are_a_table_of_at_most_ten_queries():
    frames = torch.eye(12)
    page = match(torch.cat((frames, frames * 0)), frames, top=2)._repr_html_()
    assert page.count("<tr>") == 11 and "row 3 (1.000)" in page and "14 more queries" in page
    assert "none" in match(frames[:1] * 0, frames, top=1)._repr_html_()
    town = references_of({"ssr-vlad": frames}, ["b"] * 12)
    page = recognise({"ssr-vlad": frames[:3]}, ["a"] * 3, town)._repr_html_()
    assert page.count("<th>") == 7 and "confidence" in page
