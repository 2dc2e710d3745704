import dataclasses
import math

import numpy as np
import pytest
import torch
from drawings import SKY, SPACE, TREE, blobs

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, reference
from ssrvlad_torch.config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ssrvlad_torch.stages.grid_pooling import COLUMNS, ROWS
from ssrvlad_torch.stages.harmonics import (
    Harmonics,
    coefficients,
    damped,
    harmonic_tables,
    mirrored,
    soft_histograms,
)

CONFIGS = [
    SSRVLADConfig(),
    SSRVLADConfig(rings=1, sectors=1, harmonics=1, boundary_harmonics=1),
    SSRVLADConfig(rings=3, sectors=2, harmonics=2, boundary_harmonics=3, radius=0.3),
    SSRVLADConfig(rings=5, sectors=12, harmonics=55, inner_radius=1.0, spectral_weight=0.0),
    SSRVLADConfig(rings=4, sectors=7, harmonics=20, radius=1.0, inner_radius=0.05),
]
each_config = pytest.mark.parametrize("config", CONFIGS, ids=range(len(CONFIGS)))


BLOCKS = AREA_LAYERS + BOUNDARY_DIRECTIONS


def numbers(config: SSRVLADConfig) -> tuple[int, int]:
    return config.harmonics, config.boundary_harmonics


@each_config
def test_tables_equal_the_reference(config):
    bins, basis = harmonic_tables(config)
    cells = np.random.default_rng(0).random((ROWS, COLUMNS))
    expected = reference.soft_histogram(cells, config).ravel()
    np.testing.assert_allclose(bins @ torch.from_numpy(cells).flatten(), expected, rtol=1e-12)
    most = max(numbers(config))
    expected = np.array(reference.basis(config, most)).reshape(most, -1)
    np.testing.assert_allclose(basis, expected, atol=1e-13)


def test_what_is_right_of_the_middle_is_in_the_first_sector():
    bins = harmonic_tables(SSRVLADConfig()).bins
    cells = torch.zeros(ROWS, COLUMNS, dtype=torch.float64)
    cells[ROWS // 2 - 1 : ROWS // 2 + 1, -1] = 1
    outermost = (bins @ cells.flatten()).view(6, 20)[-1]
    assert outermost.argmax() == 0
    assert outermost[1] == pytest.approx(outermost[19])  # symmetric about the axis
    assert not outermost[3:18].any()


def test_areas_and_boundaries_have_their_own_numbers():
    """A square root of fractions and of lengths in sides of a cell, the former first."""
    bins = torch.full((1, ROWS * COLUMNS), 1 / (ROWS * COLUMNS), dtype=torch.float64)
    cells = torch.zeros(1, BLOCKS, ROWS, COLUMNS, dtype=torch.float64)
    cells[0, 2], cells[0, 7] = 0.25, 0.09
    held = soft_histograms(cells, bins)
    assert held[0, :, 0].tolist() == pytest.approx([0, 0, 0.5, 0, 0, 0, 0, 0.3, 0, 0])
    basis = torch.tensor([[3.0], [4.0]], dtype=torch.float64)
    found = coefficients(held, basis, (2, 1), 1.0)[0]
    expected = torch.zeros(6 * 2 + 4)
    expected[4:6], expected[13] = torch.tensor([1.5, 2.0]), 0.9
    torch.testing.assert_close(found, expected / expected.norm())


def test_layers_that_few_networks_tell_apart_are_merged():
    """Guard rail is described as building, parking as ground."""
    module = Harmonics(SSRVLADConfig())
    own, other = torch.randint(0, 6, (2, 1, 40, 50), dtype=torch.uint8)
    rare = own.masked_fill((own == 0) & (other < 3), 7).masked_fill((own == 2) & (other < 3), 6)
    assert not torch.equal(rare, own)
    assert torch.equal(module.histograms(rare).bins, module.histograms(own).bins)


def test_empty_images_and_layers_are_exact_zeros():
    bins, basis = harmonic_tables(SSRVLADConfig(spectral_weight=2.0))
    cells = torch.rand(2, BLOCKS, ROWS, COLUMNS, dtype=torch.float64)
    cells[0], cells[1, 4] = 0, 0
    found = coefficients(soft_histograms(cells, bins), basis, (9, 9), 0.75).view(2, BLOCKS, -1)
    assert not found[0].any()
    assert not found[1, 4].any()
    assert found[1].norm().item() == pytest.approx(1)
    assert found.dtype == torch.float32


def test_power_keeps_signs_and_order():
    basis = torch.eye(4, dtype=torch.float64)
    held = torch.tensor([[[-4.0, -1.0, 0.0, 9.0]]], dtype=torch.float64)
    found = coefficients(held, basis, (4, 4), 0.5)
    expected = torch.tensor([-2.0, -1.0, 0.0, 3.0]) / math.sqrt(14)
    torch.testing.assert_close(found[0], expected)


def test_close_to_zero_the_power_is_a_straight_line():
    """So a number that rounding makes of a zero stays small."""
    one, two, coarse = (damped(torch.tensor(x).double(), 0.75) for x in (1e-7, 2e-7, 1.0))
    assert two / one == pytest.approx(2, rel=1e-5)
    assert 1e-7 < one / coarse < 2e-6
    assert damped(torch.tensor(16.0).double(), 0.75) / coarse == pytest.approx(8)


MIRRORED = [
    pytest.param(SSRVLADConfig(), (120, 160), 1e-6, id="a grid that is not reduced"),
    pytest.param(SSRVLADConfig(), (240, 322), 1e-6, id="halved"),
    pytest.param(SSRVLADConfig(), (120, 161), 1e-6, id="an odd width"),
    pytest.param(SSRVLADConfig(anchor="middle", sectors=12), (90, 120), 1e-6, id="middle"),
    pytest.param(SSRVLADConfig(), (288, 384), 0.05, id="reduced by 2.4"),
    pytest.param(SSRVLADConfig(sectors=19), (120, 160), 0.1, id="an odd number of sectors"),
]


@pytest.mark.parametrize(("config", "size", "bound"), MIRRORED)
def test_mirrored_descriptors_are_those_of_mirrored_label_maps(config, size, bound):
    labels = torch.from_numpy(np.stack([blobs(seed, *size, 9) for seed in range(6)]))
    head = SSRVLAD(dataclasses.replace(config, labels_as=SPACE))
    found, expected = head(labels), head(labels.flip(-1).contiguous())
    away = (mirrored(found, config) - expected).abs().amax(1)
    assert away.max() <= bound and (expected - found).abs().max() > 0.15
    assert torch.equal(mirrored(mirrored(found, config), config), found)


@pytest.mark.parametrize(("width", "columns", "bound"), [(40, [2, -1], 0.25), (39, [2, -2], 1e-6)])
def test_an_anchor_halfway_between_two_columns_is_rounded_to_one_side(width, columns, bound):
    labels = torch.full((1, 24, width), TREE)
    labels[..., 22:24] = SKY
    config = SSRVLADConfig(labels_as=SPACE)
    head = SSRVLAD(config)
    flipped = labels.flip(-1).contiguous()
    found = [int(head.explain(each).histograms.column) for each in (labels, flipped)]
    away = (mirrored(head(labels), config) - head(flipped)).abs().max()
    assert found == columns and bound / 3 * (bound > 0.01) < away <= bound
