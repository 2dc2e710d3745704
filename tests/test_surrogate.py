"""`SurrogateSSRVLAD`: the numbers of the head, the gradient of its twin."""

import pytest
import torch
from drawings import SPACE
from helpers import street

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, SurrogateSSRVLAD
from ssrvlad_torch.soft.descriptor import SoftSSRVLAD

CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)


def scores(dtype: torch.dtype = torch.float32) -> torch.Tensor:
    labels = torch.stack([torch.from_numpy(street(seed)) for seed in range(2)]).long()
    noise = torch.randn(2, 12, 24, 32, generator=torch.Generator().manual_seed(0))
    return (torch.eye(12)[labels].permute(0, 3, 1, 2) + noise).to(dtype).requires_grad_()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_it_has_the_numbers_of_the_head_and_the_gradient_of_the_twin(dtype):
    given, same = scores(dtype), scores(dtype)
    found, soft = SurrogateSSRVLAD(CONFIG)(given), SoftSSRVLAD(CONFIG)(same)
    assert found.requires_grad
    assert found.dtype == torch.float32
    assert torch.equal(found, SSRVLAD(CONFIG)(given.detach()))
    assert not torch.equal(found, soft.float())
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(1))
    (found * weights).sum().backward()
    (soft * weights).sum().backward()
    assert given.grad.any()
    torch.testing.assert_close(given.grad, same.grad)


def test_autocast_changes_nothing():
    head, given = SurrogateSSRVLAD(CONFIG), scores()
    outside = head(given.detach())
    with torch.autocast("cpu", torch.bfloat16):
        found = head(given)
    found[:, ::7].sum().backward()
    assert torch.equal(found, outside)
    assert given.grad.any()


def test_without_a_gradient_it_is_the_head():
    head, given = SurrogateSSRVLAD(CONFIG), scores()
    labels = given.detach().argmax(1)
    assert torch.equal(head(labels), SSRVLAD(CONFIG)(labels))
    assert not head(given.detach()).requires_grad
    with torch.no_grad():
        assert not head(given).requires_grad


def test_scores_that_require_a_gradient_give_one_warning_without_a_surrogate():
    head, given = SSRVLAD(CONFIG), scores()
    with pytest.warns(UserWarning, match="use SurrogateSSRVLAD") as warned:
        assert not head(given).requires_grad
        head(given)
    assert len(warned) == 1
