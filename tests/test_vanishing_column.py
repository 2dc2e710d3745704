import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.config import AREA_LAYERS as NONE
from ssrvlad_torch.stages.vanishing_column import LEVELS, ONE, POWER
from ssrvlad_torch.stages.vanishing_column import vanishing_columns as columns

SKY, GROUND, BUILDING = 5, 0, 2


def street(column: int, height: int = 40, width: int = 60) -> torch.Tensor:
    """Buildings left and right of an opening of nine columns."""
    numbers = torch.full((1, height, width), BUILDING)
    numbers[:, : height // 2, column - 4 : column + 5] = SKY
    numbers[:, height // 2 :, column - 4 : column + 5] = GROUND
    return numbers


def test_the_vanishing_column_lies_where_the_street_narrows():
    assert ONE.bit_length() - 1 == (LEVELS.bit_length() - 1) * POWER - 28
    found = [int(columns(street(column))) for column in (15, 30, 44)]
    assert found == sorted(found)
    assert found[0] < -9
    assert abs(found[1]) <= 1
    assert found[2] > 9


@pytest.mark.parametrize("layer", [NONE, BUILDING, SKY])
def test_an_empty_or_uniform_image_gives_the_middle(layer):
    assert columns(torch.full((2, 13, 21), layer)).tolist() == [0, 0]


@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 50), st.floats(0, 1))
def test_equals_the_reference(seed, height, width, density):
    """Also in float32, which is what exported files compute in."""
    rng = np.random.default_rng(seed)
    numbers = rng.integers(0, NONE + 1, (2, height, width))
    numbers[rng.random(numbers.shape) < density] = SKY
    found = columns(torch.from_numpy(numbers))
    assert found.dtype == torch.int64
    layers = [[image == k for k in range(NONE)] for image in numbers]
    assert found.tolist() == [reference.vanishing_column(each) for each in layers]
    assert (2 * found.abs() <= width).all()


def test_large_images_do_not_overflow():
    numbers = torch.full((1, 3000, 5000), SKY)
    numbers[:, :, :4000] = NONE
    weight, pull = 1000 * 2**20, 5000 * 2**20 // 20
    assert int(columns(numbers)) == round(weight * (4499.5 - 2499.5) / (weight + pull))
