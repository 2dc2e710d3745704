"""The stages of the twin: on zeros and ones they give what the hard stages give."""

import numpy as np
import pytest
import torch
from drawings import SPACE, blobs, one_hot
from helpers import street
from torch import Tensor

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.soft.stages import (
    are_probabilities,
    membership,
    soft_boundaries,
    soft_coefficients,
    soft_layers,
    soft_majority,
    soft_merge,
    soft_pool,
    soft_vanishing_columns,
)
from ssrvlad_torch.stages.bitplanes import unpack
from ssrvlad_torch.stages.boundaries import boundaries
from ssrvlad_torch.stages.grid_pooling import pool
from ssrvlad_torch.stages.harmonics import Harmonics
from ssrvlad_torch.stages.layers import categorise, category_table, merge, split
from ssrvlad_torch.stages.reduction import reduce_by_majority
from ssrvlad_torch.stages.vanishing_column import vanishing_columns
from ssrvlad_torch.taxonomy import NO_LAYER, label_space

MEMBERS = membership(label_space(SPACE), 12)
CELLS = 3, 4


def categories_of(labels: np.ndarray) -> Tensor:
    """``(1, h, w)`` categories of a label map."""
    return categorise(torch.from_numpy(labels)[None], *category_table(label_space(SPACE)))


def layers_of(labels: np.ndarray) -> Tensor:
    """``(1, h, w)`` bit-planes of a label map."""
    return split(categories_of(labels))


def masks_of(numbers: Tensor) -> Tensor:
    """``(B, 6, h, w)`` float64 masks of the numbers of layers."""
    return (numbers[:, None] == torch.arange(6).view(-1, 1, 1)).double()


@pytest.mark.parametrize("channels", [12, 8])
def test_one_hot_labels_give_the_layers(channels):
    """With 8 channels cars and what follows have none: what is missing to 1 is void."""
    labels = street(0)
    hot = one_hot(labels)[:, :channels].double()
    assert bool(hot.sum(1).all()) == (channels == 12)
    soft = soft_layers(hot, membership(label_space(SPACE), channels), 1.0)
    torch.testing.assert_close(soft, unpack(layers_of(labels)).double(), rtol=0, atol=2e-5)
    assert not are_probabilities(hot * 0)


def test_logits_and_their_probabilities_give_the_same():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 12, 5, 4, generator=generator).double() * 3
    assert not are_probabilities(logits)
    for dtype in (torch.float64, torch.half, torch.bfloat16):
        assert are_probabilities(logits.softmax(1).to(dtype).float())
    for temperature, error in ((0.5, 1e-4), (1.0, 1e-4), (3.0, 0.02)):
        torch.testing.assert_close(
            soft_layers(logits.softmax(1), MEMBERS, temperature),
            soft_layers(logits, MEMBERS, temperature),
            rtol=0,
            atol=error,
        )


def test_a_layer_is_the_sum_of_its_classes():
    logits = torch.randn(1, 12, 3, 3).double()
    classes, soft = logits.softmax(1), soft_layers(logits, MEMBERS, 1.0)
    torch.testing.assert_close(soft[:, 3], classes[:, 2] + classes[:, 6])  # pole and sign
    torch.testing.assert_close(soft.sum(1), 1 - classes[:, 8:].sum(1))  # dynamic and void


def test_mean_fractions_become_the_majority():
    labels = street(1, 27, 36)
    soft = unpack(layers_of(labels)).double()
    rows, columns = np.arange(27) // 3, np.arange(36) // 3
    plain = np.zeros((8, 9, 12))
    np.add.at(plain, (slice(None), rows[:, None], columns[None]), soft[0].numpy() / 9)
    np.testing.assert_allclose(soft_majority(soft, (9, 12), 1.0)[0], plain, atol=1e-5)
    categories = categorise(torch.from_numpy(labels)[None], *category_table(label_space(SPACE)))
    voted = reduce_by_majority(categories.int(), (9, 12))
    counts = torch.from_numpy(np.concatenate([plain, 1 - plain.sum(0, keepdims=True)]))
    best = counts.topk(2, dim=0).values
    clear = best[0] - best[1] > 0.05
    result = soft_majority(soft, (9, 12), 0.01)[0]
    assert clear.float().mean() > 0.8
    whole = torch.eye(NO_LAYER + 1)[voted[0].long()].permute(2, 0, 1)[:8]
    torch.testing.assert_close(result[:, clear].float(), whole[:, clear], rtol=0, atol=0.01)


def test_soft_vanishing_columns_equal_the_hard_ones_to_a_pixel():
    numbers = torch.cat([merge(categories_of(blobs(seed, 40, 60, 14))) for seed in range(8)])
    soft, hard = soft_vanishing_columns(masks_of(numbers)), vanishing_columns(numbers)
    assert hard.any()
    assert ((soft - hard).abs() <= 1.0).all()


@pytest.mark.parametrize("size", [(40, 52), (7, 5), (1, 1)])
def test_soft_pooling_equals_the_hard_one_and_interpolates_shifts(size):
    layers = unpack(torch.cat([layers_of(blobs(seed, *size, 9)) for seed in range(3)]))
    moved = torch.tensor([0, 3, -7])
    hard = pool(layers, moved)
    soft = soft_pool(layers.double(), moved.double(), tuple(hard.shape[2:]))
    torch.testing.assert_close(soft, hard)
    layers = torch.rand(1, 8, 12, 16).double()
    one, between, two = (soft_pool(layers, layers.new_tensor([x]), CELLS) for x in (1, 1.25, 2))
    torch.testing.assert_close(between, 0.75 * one + 0.25 * two)


@pytest.mark.parametrize("size", [(2, 9), (3, 3), (17, 23)])
def test_soft_boundaries_of_masks_equal_the_hard_ones(size):
    numbers = torch.cat([merge(categories_of(blobs(seed, *size, 5))) for seed in range(3)])
    assert torch.equal(soft_boundaries(masks_of(numbers)), boundaries(numbers))


def test_rare_layers_are_merged():
    layers = torch.randint(0, 9, (2, 7, 5), dtype=torch.uint8)
    merged = soft_merge(unpack(split(layers)).double())
    assert torch.equal(merged, masks_of(merge(layers)))


def test_soft_coefficients_are_near_the_hard_descriptor():
    config = SSRVLADConfig(anchor="middle", harmonics=60, boundary_harmonics=20)
    module, still = Harmonics(config), torch.zeros(3, dtype=torch.int64)
    layers = torch.cat([categories_of(blobs(seed, 48, 64, 12)) for seed in range(3)])
    numbers = merge(layers)  # a cell has two by two pixels, as a boundary has
    area, lengths = pool(masks_of(numbers), still), pool(boundaries(numbers), still)
    hard = module.descriptor(module.histograms(layers))
    tables = module.table("bins"), module.table("basis")
    soft = soft_coefficients(area, lengths, *tables, (60, 20), config.power).float()
    assert ((hard * soft).sum(1) > 0.99).all()
