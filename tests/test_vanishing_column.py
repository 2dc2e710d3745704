import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.bitplanes import pack
from ssrvlad_torch.stages.vanishing_column import LEVELS, ONE, POWER
from ssrvlad_torch.stages.vanishing_column import vanishing_columns as columns

SKY, GROUND, BUILDING = 5, 0, 2


def street(column: int, height: int = 40, width: int = 60) -> torch.Tensor:
    """Buildings left and right of an opening of nine columns."""
    layers = torch.zeros(1, 8, height, width, dtype=torch.bool)
    layers[0, BUILDING] = True
    layers[0, BUILDING, :, column - 4 : column + 5] = False
    layers[0, SKY, : height // 2, column - 4 : column + 5] = True
    layers[0, GROUND, height // 2 :, column - 4 : column + 5] = True
    return layers


def test_it_lies_where_the_street_narrows():
    assert ONE.bit_length() - 1 == (LEVELS.bit_length() - 1) * POWER - 28
    found = [int(columns(pack(street(column)))) for column in (15, 30, 44)]
    assert found == sorted(found)
    assert found[0] < -9
    assert abs(found[1]) <= 1
    assert found[2] > 9


@pytest.mark.parametrize("layer", [None, BUILDING, SKY])
def test_nothing_or_the_same_everywhere_is_the_middle(layer):
    layers = torch.zeros(2, 8, 13, 21, dtype=torch.bool)
    if layer is not None:
        layers[:, layer] = True
    assert columns(pack(layers)).tolist() == [0, 0]


@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 50), st.floats(0, 1))
def test_equals_the_reference(seed, height, width, density):
    layers = np.random.default_rng(seed).random((2, 8, height, width)) < density
    found = columns(pack(torch.from_numpy(layers)))
    assert found.dtype == torch.int64
    assert found.tolist() == [reference.vanishing_column(list(image)) for image in layers]
    assert (2 * found.abs() <= width).all()


def test_large_images_do_not_overflow():
    planes = torch.full((1, 3000, 5000), 1 << SKY, dtype=torch.uint8)
    planes[:, :, :4000] = 0
    weight, pull = 1000 * 2**20, 5000 * 2**20 // 20
    assert int(columns(planes)) == round(weight * (4499.5 - 2499.5) / (weight + pull))
