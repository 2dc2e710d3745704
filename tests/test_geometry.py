from functools import cache

import pytest
import torch
from graphs import run
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.deployment import geometry
from ssrvlad_torch.deployment.words import grid_of

CONFIG = SSRVLADConfig.from_preset("paper", closing=0.013, hole_area=0.00217, rings=4, radius=0.37)
SIZES = {"height": st.integers(1, 3000), "width": st.integers(1, 3000)}


@cache
def grids_of(size):
    return lambda graph, h, w: geometry.working_grid(graph, size, h, w)


@given(**SIZES, size=st.sampled_from([1, 7, 120, 500]))
def test_the_working_grid_is_the_configs(height, width, size):
    expected = SSRVLADConfig(working_size=size).grid(height, width)
    assert tuple(x.item() for x in run(grids_of(size), height, width)) == expected


def lengths(graph, height, width):
    grid = grid_of(graph.full([], 1, "int64"), height, width)
    return [
        geometry.radius_pixels(graph, CONFIG, CONFIG.closing, grid),
        geometry.area_pixels(CONFIG, CONFIG.hole_area, grid),
        *geometry.ring_limits(CONFIG, grid),
    ]


@given(**SIZES)
def test_lengths_and_areas_are_the_configs(height, width):
    expected = [
        CONFIG.radius_pixels(CONFIG.closing, height, width),
        CONFIG.area_pixels(CONFIG.hole_area, height, width),
        *CONFIG.ring_limits(height, width),
    ]
    assert [x.item() for x in run(lengths, height, width)] == expected


@pytest.mark.parametrize("size", [(1 << 14, 1 << 14), (1, 1 << 15)])
def test_large_images_overflow_nothing(size):
    expected = CONFIG.ring_limits(*size)
    assert [x.item() for x in run(lengths, *size)][2:] == list(expected)
    assert run(lengths, *size)[1].dtype == torch.int64


def test_a_radius_that_is_always_zero_costs_nothing():
    def build(graph, height, width):
        radius = geometry.radius_pixels(graph, CONFIG, 0.0, grid_of(height, height, width))
        assert radius == 0
        return [height]

    run(build, 5, 7)
