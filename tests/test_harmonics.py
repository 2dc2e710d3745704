from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from graphs import run

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.deployment.stages.harmonics import (
    coefficients_in_graph,
    soft_histograms_in_graph,
)
from ssrvlad_torch.stages.grid_pooling import CELLS, COLUMNS, ROWS
from ssrvlad_torch.stages.harmonics import (
    basis_table,
    bin_table,
    coefficients,
    soft_histograms,
    waves,
)

CONFIGS = [
    SSRVLADConfig(),
    SSRVLADConfig(rings=1, sectors=1, harmonics=1),
    SSRVLADConfig(rings=3, sectors=2, harmonics=3, radius=0.3),
    SSRVLADConfig(rings=5, sectors=12, harmonics=55, inner_radius=1.0, spectral_weight=0.0),
    SSRVLADConfig(rings=4, sectors=7, harmonics=20, radius=1.0, inner_radius=0.05),
]
each_config = pytest.mark.parametrize("config", CONFIGS, ids=range(len(CONFIGS)))


def tables(config: SSRVLADConfig) -> tuple[torch.Tensor, torch.Tensor]:
    return (
        bin_table(CELLS, config.rings, config.sectors, config.radius, config.inner_radius),
        basis_table(config.rings, config.sectors, config.harmonics, config.spectral_weight),
    )


@each_config
def test_tables_equal_the_reference(config):
    bins, basis = tables(config)
    cells = np.random.default_rng(0).random((ROWS, COLUMNS))
    expected = reference.soft_histogram(cells, config).ravel()
    np.testing.assert_allclose(bins @ torch.from_numpy(cells).flatten(), expected, rtol=1e-12)
    expected = np.array(reference.basis(config)).reshape(config.harmonics, -1)
    np.testing.assert_allclose(basis, expected, atol=1e-13)


@each_config
def test_bins_are_means(config):
    sums = tables(config)[0].sum(1)
    assert (torch.isclose(sums, torch.ones(1).double()) | (sums == 0)).all()


def test_what_is_right_of_the_middle_is_in_the_first_sector():
    bins, _ = tables(SSRVLADConfig())
    cells = torch.zeros(ROWS, COLUMNS, dtype=torch.float64)
    cells[ROWS // 2 - 1 : ROWS // 2 + 1, -1] = 1
    outermost = (bins @ cells.flatten()).view(6, 20)[-1]
    assert outermost.argmax() == 0
    assert outermost[1] == pytest.approx(outermost[19])  # symmetric about the axis
    assert not outermost[3:18].any()


def test_waves_rise_in_frequency_and_are_orthogonal():
    squared = [u * u + v * v for u, v, _ in waves(6, 20)]
    assert squared == sorted(squared)
    assert len(squared) == 6 * 19
    table = basis_table(6, 20, 6 * 19, 0.0)
    torch.testing.assert_close(table @ table.T, torch.eye(114).double(), rtol=0, atol=1e-12)


def test_a_mirrored_street_flips_the_sign_of_the_sines():
    """Left and right change places: angle a becomes pi - a."""
    config = SSRVLADConfig(sectors=12, power=1.0)
    bins, basis = tables(config)
    cells = torch.rand(1, 8, ROWS, COLUMNS, dtype=torch.float64)
    here, mirrored = (
        coefficients(soft_histograms(c, c, 0.1, bins), basis, 1.0).view(8, -1)
        for c in (cells, cells.flip(3))
    )
    sign = [(-1) ** v * (-1 if phase else 1) for _, v, phase in waves(6, 12)[: config.harmonics]]
    torch.testing.assert_close(mirrored, here * torch.tensor(sign), rtol=0, atol=1e-6)


def test_root_and_weight_of_the_skeleton_by_hand():
    bins = torch.full((1, ROWS * COLUMNS), 1 / (ROWS * COLUMNS), dtype=torch.float64)
    area, length = torch.zeros(2, 1, 8, ROWS, COLUMNS, dtype=torch.float64)
    area[0, 2], length[0, 2] = 0.25, 0.09
    found = soft_histograms(area, length, 0.5, bins)
    assert found[0, 2].item() == pytest.approx(0.5 + 0.5 * 0.3)
    assert found.count_nonzero() == 1


def test_empty_images_and_layers_are_exact_zeros():
    config = dataclasses.replace(SSRVLADConfig(), spectral_weight=2.0)
    bins, basis = tables(config)
    area = torch.rand(2, 8, ROWS, COLUMNS, dtype=torch.float64)
    area[0], area[1, 4] = 0, 0
    found = coefficients(soft_histograms(area, area, 0.1, bins), basis, 0.75).view(2, 8, -1)
    assert not found[0].any()
    assert not found[1, 4].any()
    assert found[1].norm().item() == pytest.approx(1)
    assert found.dtype == torch.float32


def test_power_keeps_signs_and_order():
    basis = torch.eye(4, dtype=torch.float64)
    held = torch.tensor([[[-4.0, -1.0, 0.0, 9.0]]], dtype=torch.float64)
    found = coefficients(held, basis, 0.5)
    expected = torch.tensor([-2.0, -1.0, 0.0, 3.0]) / math.sqrt(14)
    torch.testing.assert_close(found[0], expected)


@each_config
def test_the_same_in_a_graph(config):
    bins, basis = tables(config)

    def in_graph(graph, area, lengths):
        found = soft_histograms_in_graph(graph, area, lengths, config.skeleton_weight, bins)
        return [found, coefficients_in_graph(graph, found, basis, config.power)]

    area, lengths = torch.rand(2, 3, 8, ROWS, COLUMNS, dtype=torch.float64)
    area[1], lengths[1], area[0, 3] = 0, 0, 0
    histograms, descriptor = run(in_graph, area, lengths)
    expected = soft_histograms(area, lengths, config.skeleton_weight, bins)
    torch.testing.assert_close(histograms, expected, rtol=1e-12, atol=1e-15)
    expected = coefficients(expected, basis, config.power)
    torch.testing.assert_close(descriptor, expected, rtol=0, atol=1e-7)
    assert not descriptor[1].any()
