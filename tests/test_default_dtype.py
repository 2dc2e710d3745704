"""Whatever torch's default dtype is, as another library may set it, all numbers are the same."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from drives import write_maps
from helpers import street
from networks import photo
from segmenting import write_named_network, write_photos

from ssrvlad_torch import SSRVLAD, LoopDetector, Map, match
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.segmentation.preparation import Preparation, SegmenterConfig
from ssrvlad_torch.stages.features import Features

DTYPES = [torch.float64, torch.float16, torch.bfloat16]
MAPS = torch.from_numpy(np.stack([street(seed, 60, 80) % 11 for seed in range(3)]))
SCORES = torch.nn.functional.one_hot(MAPS.long(), 11).permute(0, 3, 1, 2).to(torch.float32)


@contextmanager
def default(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def assert_same(numbers, dtype):
    """A function gives tensors of the same dtype and bits under another default."""
    expected = numbers()
    with default(dtype):
        results = numbers()
    for result, right in zip(results, expected, strict=True):
        assert result.dtype == right.dtype
        assert torch.equal(result, right)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("native", [True, False])
def test_descriptors(dtype, preset, native):
    def numbers():
        head = SSRVLAD.from_preset(preset, labels_as="camvid-11")
        head.native = head.native and native
        return head(MAPS), head(SCORES)

    assert_same(numbers, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_anchors(dtype):
    head = SSRVLAD.from_preset("default", labels_as="camvid-11")
    assert_same(lambda: [head.sweep(MAPS, (-4, 0, 4))], dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_input_of_a_network_and_its_features(dtype):
    pictures = torch.from_numpy(np.stack([photo(street(seed, 96, 128)) for seed in range(2)]))
    random = torch.Generator().manual_seed(0)
    noise = torch.rand(16, 3, 24, 32, generator=random, dtype=torch.float32)

    def numbers():
        planes = Preparation(SegmenterConfig(size=(48, 64)))(pictures)
        return planes, Features(noise)(planes)

    assert_same(numbers, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_matches(dtype):
    rows = torch.rand(40, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float32)
    assert_same(lambda: [*match(rows, rows.flip(0), top=3)], dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_loops(dtype):
    def answers():
        head = SSRVLAD.from_preset("default", labels_as="camvid-11")
        detector = LoopDetector(LoopConfig(exclude=3), head)
        seeds = (*range(8), *range(2, 8))
        return [detector.update(street(seed), f"a/{n}") for n, seed in enumerate(seeds)]

    expected = answers()
    with default(dtype):
        assert answers() == expected


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_map_of_label_maps(dtype, tmp_path):
    monday, today = (write_maps(tmp_path / day, range(35)) for day in ("monday", "today"))

    def answers(name):
        town = Map.open(tmp_path / name, labels_as="camvid-11")
        town.add(monday)
        return town.database.load().descriptors, [*town.query(today)]

    stored, expected = answers("right")
    with default(dtype):
        also_stored, results = answers("town")
    assert torch.equal(also_stored, stored)
    assert content_of(results) == content_of(expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_pictures_that_are_located(dtype, tmp_path):
    pictures = write_photos(tmp_path / "monday")
    network = str(write_named_network(tmp_path))
    Map.open(tmp_path / "town", network).add(pictures)
    several = sorted(pictures.iterdir())
    expected = Map.open(tmp_path / "town", network).locate(several)
    with default(dtype):
        assert content_of(Map.open(tmp_path / "town", network).locate(several)) == content_of(
            expected
        )


def content_of(answers):
    """The candidates, scores and confidences of answers."""
    candidates = [[(each.frame, each.score) for each in answer.candidates] for answer in answers]
    assert all(candidates)
    return candidates, [answer.confidence for answer in answers]
