import math

import pytest
import torch
import torch.nn.functional as F
from helpers import descriptors

from ssrvlad_torch.recognition.decoys import decoy_scores, lead_over_decoys
from ssrvlad_torch.recognition.matching import Rows
from ssrvlad_torch.recognition.sweep import score


def mirror(vectors: torch.Tensor) -> torch.Tensor:
    """An exchange and a sign, as every method has."""
    return vectors.flip(-1) * torch.tensor([1.0, -1, -1, 1]).repeat(vectors.shape[-1] // 4)


@pytest.mark.parametrize("common", [False, True])
@pytest.mark.parametrize("anchors", [None, 3])
def test_decoys_are_the_mirrored_rows(anchors, common):
    """What all rows have in common is not mirrored."""
    references = descriptors(0, 30, 16) * 3
    if common:
        references = F.normalize(descriptors(0, 30, 16) + 2 * descriptors(2, 1, 16), dim=1)
    references[4] = 0
    queries = descriptors(1, 5 * (anchors or 1), 16)
    queries = queries.view(5, anchors, 16) if anchors else queries
    queries[2] = 0
    mean = references.sum(0) / 29 if common else torch.zeros(16)
    decoys = (mean + mirror(references - mean)) * references.any(1, keepdim=True)
    found = decoy_scores(queries, Rows.of(references), mirror, mean if common else None)
    torch.testing.assert_close(found, score(queries, decoys))
    assert (found[2] == -torch.inf).all() and (found[:, 4] == -torch.inf).all()


def test_the_lead_is_that_of_the_winner_over_all_others():
    near = torch.zeros(40)
    near[10], near[14], near[30] = 5.0, 4.5, 2.0
    scores = 1 - torch.exp(-near)
    decoys = 1 - torch.exp(-torch.zeros(40).index_fill_(0, torch.tensor([20]), 3.0))
    spread = float(torch.cat((near, torch.zeros(39), torch.tensor([3.0]))).std(correction=0))
    found = lead_over_decoys(scores, decoys)
    assert found.value == pytest.approx((5 - 3) / spread, rel=1e-4) and found.decoy == 20
    swapped = lead_over_decoys(decoys, scores)
    assert swapped.value == pytest.approx(-(5 - 3) / spread, rel=1e-4) and swapped.decoy == 10
    assert lead_over_decoys(scores, deviation=1.0).value == pytest.approx(5 - 2, rel=1e-5)


def test_the_lead_of_some_rows_is_that_of_all():
    scores, decoys = descriptors(3, 2, 60) * 0.9
    rows, others = (each.topk(25).indices.sort().values for each in (scores, decoys))
    whole = lead_over_decoys(scores, decoys, deviation=0.3)
    assert lead_over_decoys(scores[rows], decoys[others], rows, others, 0.3) == whole


def test_no_candidate_has_no_lead():
    none = torch.full((20,), -torch.inf)
    assert math.isnan(lead_over_decoys(none, torch.zeros(20)).value)
    assert math.isnan(lead_over_decoys(torch.zeros(3)).value)
    assert lead_over_decoys(torch.eye(20)[3], none).value > 1
