import pytest
import torch
from drawings import MASKS, mask, planes
from graphs import run_on_planes
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch.deployment.graph import Graph, Symbol
from ssrvlad_torch.deployment.words import (
    Words,
    count_points_in_graph,
    east_of,
    first_of_runs,
    inside,
    neighbourhood,
    paint_in_graph,
    points_of,
    runs_of,
    west_of,
)
from ssrvlad_torch.stages import bitplanes

shapes = pytest.mark.parametrize(
    "shape", [(1, 1, 1), (2, 5, 7), (3, 4, 8), (2, 13, 17), (1, 3, 65)]
)


def all_neighbours(graph: Graph, words: Words) -> list[Words]:
    pixels, ring = neighbourhood(graph, words)
    sides = (west_of(graph, words.line), east_of(graph, words.line))
    within = inside(graph, words.grid)
    return [words.with_line(part & within) for part in (pixels, *ring, *sides)]


@shapes
def test_neighbours_are_those_of_bit_planes(shape):
    layers = random_planes(1, shape)
    ring = bitplanes.neighbours(layers)
    expected = (layers, *ring, ring[6], ring[2])
    for got, target in zip(run_on_planes(all_neighbours, layers), expected, strict=True):
        assert torch.equal(got, target)


def listed(graph: Graph, words: Words) -> list[Symbol]:
    points = points_of(graph, words)
    return [*points, count_points_in_graph(graph, points, words.grid.images)]


@given(seed=st.integers(0, 10_000), height=st.integers(1, 12), width=st.integers(1, 20))
def test_points_are_listed_as_from_bit_planes(seed, height, width):
    layers = random_planes(seed, (2, height, width)) & random_planes(seed + 1, (2, height, width))
    *points, counts = run_on_planes(listed, layers)
    expected = bitplanes.points(layers)
    for got, target in zip(points, expected, strict=True):
        assert torch.equal(got, target)
    assert torch.equal(counts, bitplanes.count_points(expected, 2))


def runs(graph: Graph, words: Words) -> list[Symbol]:
    found, grid = runs_of(graph, words.line), words.grid
    group = found.layer * grid.images + grid.image(found.first)
    columns = (grid.column(found.first), grid.column(found.last))
    return [group, grid.row(found.first), *columns, found.length]


@given(seed=st.integers(0, 10_000), height=st.integers(1, 12), width=st.integers(1, 20))
def test_runs_are_listed_as_from_bit_planes(seed, height, width):
    layers = random_planes(seed, (2, height, width)) | random_planes(seed + 1, (2, height, width))
    *columns, length = run_on_planes(runs, layers)
    expected = bitplanes.runs(layers)
    for got, target in zip(columns, expected, strict=True):
        assert torch.equal(got, target)
    assert torch.equal(length, expected.last - expected.first + 1)


def repainted(graph: Graph, words: Words) -> list[Words]:
    found = runs_of(graph, words.line)
    long = paint_in_graph(graph, found.where(found.length > 2), words.grid)
    lines = (paint_in_graph(graph, found, words.grid), long, first_of_runs(graph, words.line))
    return [words.with_line(line) for line in lines]


@shapes
def test_painting_all_runs_gives_the_planes_back(shape):
    for layers in (random_planes(3, shape), torch.full(shape, 255, dtype=torch.uint8)):
        assert torch.equal(run_on_planes(repainted, layers)[0], layers)


@pytest.mark.parametrize("name", MASKS)
def test_painting_chosen_runs(name):
    layers = planes(mask(MASKS[name]), ~mask(MASKS[name]))
    found = bitplanes.runs(layers)
    long = found.last - found.first + 1 > 2
    chosen = bitplanes.Runs(*(column[long] for column in found))
    _, painted, first = run_on_planes(repainted, layers)
    assert torch.equal(painted, bitplanes.paint(chosen, layers.shape))
    assert torch.equal(first, layers & ~bitplanes.neighbours(layers)[6])
