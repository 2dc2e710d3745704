"""The twin as a whole: near the hard descriptor, with gradients that lead to it; the surrogate and
the loss of places."""

import math

import numpy as np
import pytest
import torch
from drawings import SPACE, blobs, degenerate, one_hot
from helpers import refuses, street
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, SurrogateSSRVLAD
from ssrvlad_torch.soft.descriptor import SoftSSRVLAD
from ssrvlad_torch.soft.place_loss import multi_similarity
from ssrvlad_torch.soft.stages import soft_boundaries, soft_pool, soft_vanishing_columns
from ssrvlad_torch.stages.boundaries import boundaries
from ssrvlad_torch.stages.grid_pooling import pool
from ssrvlad_torch.stages.layers import categorise, category_table, merge
from ssrvlad_torch.stages.vanishing_column import vanishing_columns
from ssrvlad_torch.taxonomy import label_space

DEFAULT = SSRVLADConfig.from_preset("default", labels_as=SPACE)
TINY = {"labels_as": SPACE, "closing": 0.2, "hole_area": 0.02, "region_area": 0.02}
CONFIGS = {
    "default": SSRVLADConfig.from_preset("default", **TINY),
    "default, 6 rows": SSRVLADConfig.from_preset("default", working_size=6, **TINY),
    "default, middle": SSRVLADConfig.from_preset("default", anchor="middle", **TINY),
}


@pytest.fixture(params=CONFIGS)
def config(request):
    return CONFIGS[request.param]


def scores(seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """``(1, 12, 9, 11)`` logits that need a gradient."""
    generator = torch.Generator().manual_seed(seed)
    result = torch.randn(1, 12, 9, 11, generator=generator, dtype=torch.float64) * 2
    return result.to(dtype).requires_grad_()


def cosine(first: Tensor, others: Tensor) -> float:
    return float(torch.cosine_similarity(first.double(), others.double()).mean())


@pytest.mark.parametrize("fast", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_gradients_pass_gradcheck(config, fast):
    probabilities = scores(1).softmax(1).detach().requires_grad_()
    for inputs, temperature in ((scores(0), 1.0), (scores(0), 0.5), (probabilities, 2.0)):
        twin = SoftSSRVLAD(config, temperature)
        assert torch.autograd.gradcheck(twin, inputs, fast_mode=fast, atol=1e-4)


def extreme() -> dict[str, Tensor]:
    """Extreme class scores."""
    noise = torch.randn(1, 12, 20, 30, generator=torch.Generator().manual_seed(0))
    images = {name: one_hot(labels) for name, labels in degenerate().items()}
    return images | {f"noise of {size:g}": noise * size for size in (0.0, 1e-8, 1e4)}


@pytest.mark.parametrize("name", extreme())
def test_gradients_are_finite_for_extreme_scores(name):
    twin = SoftSSRVLAD(DEFAULT)
    inputs = extreme()[name].requires_grad_()
    result = twin(inputs)
    (result.square().sum() + result[0, ::7].sum()).backward()
    assert result.isfinite().all()
    assert inputs.grad.isfinite().all()
    assert float(result.detach().norm()) <= 1 + 1e-5


@pytest.mark.parametrize("size", [(40, 52), (7, 5), (1, 1)])
def test_of_zeros_and_ones_stages_give_what_the_hard_ones_give(size):
    """The vanishing column to a pixel: the hard one is rounded."""
    labels = torch.from_numpy(np.stack([blobs(seed, *size, 9) for seed in range(3)]))
    numbers = merge(categorise(labels, *category_table(label_space(SPACE))))
    masks, shift = (numbers[:, None] == torch.arange(6).view(-1, 1, 1)).double(), [0, 3, -7]
    hard = pool(masks, torch.tensor(shift))
    soft = soft_pool(masks, torch.tensor(shift).double(), tuple(hard.shape[2:]))
    torch.testing.assert_close(soft, hard)
    assert torch.equal(soft_boundaries(masks), boundaries(numbers))
    apart = soft_vanishing_columns(masks) - vanishing_columns(numbers)
    assert (apart.abs() <= 1).all()


def test_gradients_lead_to_another_place():
    """Scores that follow the twin's gradient towards a place get that place's hard descriptor."""
    hard, twin = SSRVLAD(DEFAULT), SoftSSRVLAD(DEFAULT)
    here, there = street(1), street(2)
    expected = hard(torch.from_numpy(there)[None])
    inputs = (one_hot(here) * 2).requires_grad_()
    before = cosine(hard(inputs.detach()), expected)
    optimiser = torch.optim.Adam([inputs], lr=0.1)
    for _ in range(30):
        optimiser.zero_grad()
        (-(twin(inputs) * expected).sum()).backward()
        optimiser.step()
    assert cosine(hard(inputs.detach()), expected) > before + 0.1


def test_dtype_follows_the_input_and_autocast_is_ignored():
    twin = SoftSSRVLAD(DEFAULT)
    logits = torch.randn(2, 12, 10, 13)
    assert twin(logits).dtype == torch.float32
    assert twin(logits.double()).dtype == torch.float64
    assert twin(logits[:, :11]).shape == (2, 480)
    for dtype in (torch.half, torch.bfloat16):
        narrow = logits.to(dtype).requires_grad_()
        result = twin(narrow)
        result.sum().backward()
        assert result.dtype == torch.float32
        assert narrow.grad.dtype == dtype
    with torch.autocast("cpu", torch.bfloat16):
        under = twin(logits)
    torch.testing.assert_close(under, twin(logits), rtol=0, atol=1e-6)


@pytest.mark.parametrize("temperature", [0, -1.0, float("inf"), float("nan")])
def test_a_wrong_temperature_and_the_paper_are_refused(temperature):
    refuses("temperature must be a number above 0, got", SoftSSRVLAD, temperature=temperature)
    refuses("needs the aggregation harmonics", SoftSSRVLAD, SSRVLADConfig.from_preset("paper"))


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (torch.zeros(1, 4, 5), r"expected \(B, C, H, W\) class scores, got \(1, 4, 5\)"),
        (torch.zeros(1, 4, 5, 6), "class scores have 4 classes"),
        (torch.zeros(1, 19, 5, 6, dtype=torch.int64), "must be floating point"),
        (torch.full((1, 19, 5, 6), torch.nan), "NaN"),
        (torch.zeros(1, 19, 5, 6).index_fill(3, torch.tensor([2]), torch.inf), "5 pixels are inf"),
        (torch.full((1, 19, 5, 6), -torch.inf), "30 pixels are infinite"),
        (torch.zeros(0, 19, 5, 6), "at least one image"),
    ],
)
def test_wrong_input_is_refused(inputs, message):
    refuses(message, SoftSSRVLAD(), inputs)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_the_surrogate_has_the_numbers_of_the_head_and_the_gradient_of_the_twin(dtype):
    inputs, same = scores(0, dtype), scores(0, dtype)
    result, soft = SurrogateSSRVLAD(DEFAULT)(inputs), SoftSSRVLAD(DEFAULT)(same)
    assert result.requires_grad
    assert result.dtype == torch.float32
    assert torch.equal(result, SSRVLAD(DEFAULT)(inputs.detach()))
    assert not torch.equal(result, soft.float())
    weights = torch.randn(result.shape, generator=torch.Generator().manual_seed(1))
    (result * weights).sum().backward()
    (soft * weights).sum().backward()
    assert inputs.grad.any()
    torch.testing.assert_close(inputs.grad, same.grad)


def test_without_a_gradient_it_is_the_head():
    head, inputs = SurrogateSSRVLAD(DEFAULT), scores(0, torch.float32)
    labels = inputs.detach().argmax(1)
    assert torch.equal(head(labels), SSRVLAD(DEFAULT)(labels))
    assert not head(inputs.detach()).requires_grad
    with torch.no_grad():
        assert not head(inputs).requires_grad


def test_scores_that_require_a_gradient_give_one_warning_without_a_surrogate():
    head, inputs = SSRVLAD(DEFAULT), scores(0, torch.float32)
    with pytest.warns(UserWarning, match="use SurrogateSSRVLAD") as warned:
        assert not head(inputs).requires_grad
        head(inputs)
    assert len(warned) == 1


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
    for inputs, other in ((kind == 0, kind == 0), (None, kind != 1)):
        result = multi_similarity(similarity, kind == 1, inputs, *settings)
        expected = plainly(similarity, kind == 1, other, *settings)
        assert float(result) == pytest.approx(float(expected))
