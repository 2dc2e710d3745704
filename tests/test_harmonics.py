import numpy as np
import pytest
import torch

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ssrvlad_torch.stages.grid_pooling import COLUMNS, ROWS
from ssrvlad_torch.stages.harmonics import HarmonicHistograms, Harmonics

CONFIGS = [
    SSRVLADConfig(),
    SSRVLADConfig(rings=1, sectors=1, harmonics=1, boundary_harmonics=1),
    SSRVLADConfig(rings=3, sectors=2, harmonics=2, boundary_harmonics=3, radius=0.3),
    SSRVLADConfig(rings=5, sectors=12, harmonics=55, inner_radius=1.0, spectral_weight=0.0),
    SSRVLADConfig(rings=4, sectors=7, harmonics=20, radius=1.0, inner_radius=0.05),
]
each_config = pytest.mark.parametrize("config", CONFIGS, ids=range(len(CONFIGS)))


BLOCKS = AREA_LAYERS + BOUNDARY_DIRECTIONS


@each_config
def test_tables_equal_the_reference(config):
    module = Harmonics(config)
    cells = np.random.default_rng(0).random((ROWS, COLUMNS))
    result = module.table("bins") @ torch.from_numpy(cells).flatten()
    expected = reference.soft_histogram(cells, config).ravel()
    np.testing.assert_allclose(result, expected, rtol=1e-12)
    most = max(config.harmonics, config.boundary_harmonics)
    expected = np.array(reference.basis(config, most)).reshape(most, -1)
    np.testing.assert_allclose(module.table("basis"), expected, atol=1e-13)


def test_what_is_right_of_the_middle_is_in_the_first_sector():
    cells = torch.zeros(ROWS, COLUMNS, dtype=torch.float64)
    cells[ROWS // 2 - 1 : ROWS // 2 + 1, -1] = 1
    bins = Harmonics(SSRVLADConfig()).table("bins")
    outermost = (bins @ cells.flatten()).view(6, 20)[-1]
    assert outermost.argmax() == 0
    assert outermost[1] == pytest.approx(outermost[19])  # symmetric about the axis
    assert not outermost[3:18].any()


def test_layers_that_few_networks_tell_apart_are_merged():
    """Guard rail is described as building, parking as ground."""
    module = Harmonics(SSRVLADConfig())
    usual, other = torch.randint(0, 6, (2, 1, 40, 50), dtype=torch.uint8)
    rare = usual.masked_fill((usual == 0) & (other < 3), 7).masked_fill(
        (usual == 2) & (other < 3), 6
    )
    assert not torch.equal(rare, usual)
    assert torch.equal(module.histograms(rare).bins, module.histograms(usual).bins)


SIX = SSRVLADConfig(
    rings=2, sectors=4, harmonics=6, boundary_harmonics=3, spectral_weight=0.0, power=0.5
)
"""Two rings and four sectors have six basis functions; all have length 1."""


def descriptor_of(values: dict[tuple[int, int], float]) -> torch.Tensor:
    """The descriptor of histograms with the wanted coefficients, by block and number, else 0."""
    module, coefficients = Harmonics(SIX), torch.zeros(1, BLOCKS, 6, dtype=torch.float64)
    for place, value in values.items():
        coefficients[0][place] = value
    bins = (coefficients @ module.table("basis")).unflatten(2, (2, 4))
    return module.descriptor(HarmonicHistograms(bins, torch.zeros(1, dtype=torch.int64)))[0]


def test_areas_and_boundaries_have_their_own_numbers_and_keep_their_signs():
    """Six numbers of each area, three of each direction, to a power."""
    result = descriptor_of({(2, 0): -4.0, (2, 5): -1.0, (6, 2): 9.0, (7, 4): 9.0})
    assert result.dtype == torch.float32
    expected = torch.zeros(6 * 6 + 4 * 3)
    expected[[12, 17, 38]] = torch.tensor([-2.0, -1.0, 3.0]) / 14**0.5
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-7)
    assert not result[:12].any()  # of layers without pixels
    assert not descriptor_of({}).any()


def test_close_to_zero_the_power_is_a_straight_line():
    """So a number that rounding makes of a zero stays small."""
    large, one, two = descriptor_of({(0, 0): 1.0, (0, 1): 1e-7, (0, 2): 2e-7})[:3]
    assert two / one == pytest.approx(2, rel=1e-5)
    assert 1e-7 < one / large < 2e-5
