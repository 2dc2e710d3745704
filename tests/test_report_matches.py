"""Which matches are shown, and what the categories of two descriptors add to their score."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from helpers import descriptors
from reports import Page, frame_set, report_of

from ssrvlad_torch.evaluation.outcomes import judge
from ssrvlad_torch.evaluation.report import Descriptors, stored_scores
from ssrvlad_torch.evaluation.report.matches import Match, choose, parts
from ssrvlad_torch.evaluation.report.page import render

SIMILARITY = np.array(
    [
        [0.9, 0.1, 0.2, 0.0],  # right
        [0.8, 0.7, 0.1, 0.0],  # wrong by 0.1, the better of two true matches counts
        [0.6, 0.5, 0.1, 0.2],  # wrong by 0.5
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


def test_the_strongest_cases_come_first(outcomes):
    chosen = choose(stored_scores(SIMILARITY), outcomes, TRUTH, most=9)
    assert [match.query for match in chosen.confident] == [3, 1, 2, 6]
    assert [match.query for match in chosen.worst] == [2, 6, 1]
    assert [match.query for match in chosen.best] == [4, 0]
    assert chosen.worst[0] == Match(2, 0, 0.6, False, true_match=2, true_score=0.1)
    assert (chosen.worst[2].true_match, chosen.worst[2].true_score) == (1, 0.7)
    assert chosen.confident[0].true_match == -1
    assert chosen.best[0].correct
    few = choose(stored_scores(SIMILARITY), outcomes, TRUTH, most=1)
    assert [len(kind) for kind in few] == [1, 1, 1]


def test_nothing_to_choose_from():
    empty = judge(np.zeros((0, 2)), np.zeros((0, 2), np.int64), [])
    assert choose(stored_scores(np.zeros((0, 3))), empty, [], 4) == ([], [], [])


def test_parts_sum_to_the_score_and_to_the_squared_distance():
    query, references = 3 * descriptors(0, 1)[0], descriptors(1, 5)
    added = parts(query, references, 8)
    unit = (query / query.norm()).double()
    assert added.score.shape == added.difference.shape == (5, 8)
    np.testing.assert_allclose(added.score.sum(1), (references.double() @ unit).numpy(), atol=1e-6)
    squared = ((references - unit) ** 2).sum(1).numpy()
    np.testing.assert_allclose(added.difference.sum(1), squared, atol=1e-6)


def test_a_category_is_its_block():
    query = torch.zeros(16)
    query[[0, 6]] = torch.tensor([3.0, 4.0])  # blocks 0 and 3
    reference = torch.zeros(1, 16)
    reference[0, 7] = 1.0  # block 3, another number of it
    added = parts(query, reference, 8)
    np.testing.assert_allclose(added.score[0], np.zeros(8))
    np.testing.assert_allclose(added.difference[0], [0.36, 0, 0, 0.64 + 1, 0, 0, 0, 0], atol=1e-7)


def test_the_table_tells_what_leads_to_the_wrong_place():
    queries, references = (
        frame_set(torch.tensor(rows), name)
        for rows, name in (([[0.6, 0.8]], "query"), ([[1.0, 0.0], [0.0, 1.0]], "reference"))
    )
    report = report_of(queries, references, [[0]])
    vectors = Descriptors(queries.descriptors, references.descriptors, ("road & rail", "sky"))
    page = Page(render(dataclasses.replace(report, descriptors=vectors)))
    assert "road & rail 0.000 -0.6000 0.360" in page.words
    assert "sky 0.800 0.8000 0.040" in page.words
    assert "sum 0.800 0.2000 0.400" in page.words
    widths = [a["style"] for a in page.all("td", "lead")]
    assert widths[:2] == ["--fraction:75%", "--fraction:100%"]
