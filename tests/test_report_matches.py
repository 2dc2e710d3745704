"""Which matches are shown, and what the parts of two descriptors add to their cosine."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import descriptors
from reports import Page, frame_set, report_of

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.evaluation.outcomes import judge
from ssrvlad_torch.evaluation.report import Descriptors, stored_scores
from ssrvlad_torch.evaluation.report.matches import Match, choose, contributions
from ssrvlad_torch.evaluation.report.page import render
from ssrvlad_torch.stages.boundaries import DIRECTIONS
from ssrvlad_torch.taxonomy import CATEGORIES

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
    assert chosen.worst[0] == Match(2, 0, 0.6, False, 2, frame_score=0.6, true_frame_score=0.1)
    assert (chosen.worst[2].true_match, chosen.worst[2].true_frame_score) == (1, 0.7)
    assert chosen.confident[0].true_match == -1
    assert chosen.best[0].correct
    few = choose(stored_scores(SIMILARITY), outcomes, TRUTH, most=1)
    assert [len(kind) for kind in few] == [1, 1, 1]


def test_margins_are_of_single_frames(outcomes):
    """Though the sequence decided, with scores of its own."""
    followed = dataclasses.replace(outcomes, score=outcomes.score / 10)
    chosen = choose(stored_scores(SIMILARITY), followed, TRUTH, most=9)
    assert [match.query for match in chosen.worst] == [2, 6, 1]
    assert (chosen.worst[0].score, chosen.worst[0].frame_score) == (pytest.approx(0.06), 0.6)


def test_nothing_to_choose_from():
    empty = judge(np.zeros((0, 2)), np.zeros((0, 2), np.int64), [])
    assert choose(stored_scores(np.zeros((0, 3))), empty, [], 4) == ([], [], [])


def test_contributions_sum_to_the_cosine():
    query, references = 3 * descriptors(0, 1)[0], descriptors(1, 5)
    width = references.shape[1]
    added = contributions(query, references, [5, width - 9, 4])
    assert added.shape == (5, 3)
    unit = (query / query.norm()).double()
    np.testing.assert_allclose(added.sum(1), (references.double() @ unit).numpy(), atol=1e-6)


def test_a_part_is_where_it_stands():
    query = torch.zeros(16)
    query[[0, 6]] = torch.tensor([3.0, 4.0])
    reference = torch.zeros(1, 16)
    reference[0, 6] = 1.0
    np.testing.assert_allclose(contributions(query, reference, [6, 2, 8]), [[0, 0.8, 0]])


@pytest.mark.parametrize(
    ("preset", "names", "lengths"),
    [
        ("paper", CATEGORIES, {60}),
        ("default", (*CATEGORIES[:6], *(f"{d} boundaries" for d in DIRECTIONS)), {64, 24}),
    ],
)
def test_the_parts_of_the_presets(preset, names, lengths):
    config = SSRVLADConfig.from_preset(preset)
    made = Descriptors.of(torch.zeros(1, 480), torch.zeros(1, 480), config)
    assert (tuple(made.parts), {*made.parts.values()}) == (tuple(names), lengths)
    assert sum(made.parts.values()) == config.length


def test_the_table_tells_what_leads_to_the_wrong_place():
    queries, references = (
        frame_set(torch.tensor(rows), name)
        for rows, name in (([[0.6, 0.8]], "query"), ([[1.0, 0.0], [0.0, 1.0]], "reference"))
    )
    report = report_of(queries, references, [[0]])
    vectors = Descriptors(queries.descriptors, references.descriptors, {"road & rail": 1, "sky": 1})
    page = Page(render(dataclasses.replace(report, descriptors=vectors)))
    assert "road & rail 0.000 -0.600" in page.words
    assert "sky 0.800 0.800" in page.words
    assert "sum 0.800 0.200" in page.words
    widths = [a["style"] for a in page.all("td", "lead")]
    assert widths[:2] == ["--fraction:75%", "--fraction:100%"]
