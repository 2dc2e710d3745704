"""The multi-similarity loss against its formula, pair by pair."""

import math

import pytest
import torch

from ssrvlad_torch.soft.place_loss import multi_similarity


def plainly(similarity, same, other, alpha, beta, base):
    """Eq. 15 of Wang et al., CVPR 2019."""
    total = 0.0
    for row, alike, unlike in zip(similarity, same, other, strict=True):
        pull = sum(math.exp(-alpha * (s - base)) for s, a in zip(row, alike, strict=True) if a)
        push = sum(math.exp(beta * (s - base)) for s, u in zip(row, unlike, strict=True) if u)
        total += math.log(1 + pull) / alpha + math.log(1 + push) / beta
    return total / len(similarity)


@pytest.mark.parametrize("settings", [(2.0, 50.0, 0.5), (10.0, 5.0, 0.9)])
def test_the_loss_is_equation_15_pair_by_pair(settings):
    similarity = torch.rand(5, 7, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    kind = torch.randint(0, 3, (5, 7), generator=torch.Generator().manual_seed(1))
    kind[0], kind[1] = 0, 2  # a query of which nothing is the same, one of which nothing is known
    for given, other in ((kind == 0, kind == 0), (None, kind != 1)):
        found = multi_similarity(similarity, kind == 1, given, *settings)
        expected = plainly(similarity, kind == 1, other, *settings)
        assert float(found) == pytest.approx(float(expected))


def test_gradients_pull_the_same_place_and_push_others():
    similarity = torch.rand(3, 4, dtype=torch.float64, requires_grad=True)
    same = torch.tensor([[1, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]]).bool()
    assert torch.autograd.gradcheck(lambda s: multi_similarity(s, same), similarity)
    similarity.grad = None
    multi_similarity(similarity, same).backward()
    assert (similarity.grad[same] < 0).all()
    assert (similarity.grad[~same] > 0).all()


def test_no_pair_costs_nothing():
    similarity = torch.rand(2, 3, requires_grad=True)
    nothing = torch.zeros(2, 3, dtype=torch.bool)
    loss = multi_similarity(similarity, nothing, nothing)
    loss.backward()
    assert float(loss.detach()) == 0
    assert not similarity.grad.any()


@pytest.mark.parametrize(
    ("similarity", "same", "message"),
    [
        (torch.rand(3), torch.rand(3) < 1, "one shape"),
        (torch.rand(3, 4), torch.rand(4, 3) < 1, r"got \(3, 4\), \(4, 3\), \(4, 3\)"),
        (torch.rand(0, 4), torch.rand(0, 4) < 1, "at least one query"),
    ],
)
def test_wrong_input_is_refused(similarity, same, message):
    with pytest.raises(ValueError, match=message):
        multi_similarity(similarity, same)
