"""Whatever torch's default dtype is, as another library may set it, all numbers are the same."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch
from helpers import street, write_maps
from networks import photo

from ssrvlad_torch import SSRVLAD, LoopDetector, Map
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.segmentation.preparation import Preparation, SegmenterConfig
from ssrvlad_torch.stages.features import Features

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


def described(_, preset="default"):
    head = SSRVLAD.from_preset(preset, labels_as="camvid-11")
    return head(MAPS), head(SCORES)


def prepared(_):
    """The input of a network, and its features."""
    pictures = torch.from_numpy(np.stack([photo(street(seed, 96, 128)) for seed in range(2)]))
    random = torch.Generator().manual_seed(0)
    noise = torch.rand(16, 3, 24, 32, generator=random, dtype=torch.float32)
    planes = Preparation(SegmenterConfig(size=(48, 64)))(pictures)
    return planes, Features(noise)(planes)


def looped(_):
    head = SSRVLAD.from_preset("default", labels_as="camvid-11")
    detector = LoopDetector(LoopConfig(exclude=3), head)
    seeds = enumerate((*range(8), *range(2, 8)))
    return [detector.update(street(seed), f"a/{number}") for number, seed in seeds]


def queried(folder):
    monday, today = (write_maps(folder / day, range(35)) for day in ("monday", "today"))
    town = Map.open(folder / "town", labels_as="camvid-11")
    town.add(monday)
    return town.database.load().descriptors, *content_of(town.query(today))


def content_of(answers):
    """The candidates, scores and confidences of answers."""
    answers = [*answers]
    candidates = [[(place.frame, place.score) for place in one.candidates] for one in answers]
    assert all(candidates)
    return candidates, [answer.confidence for answer in answers]


JOBS = {
    "descriptors": described,
    "descriptors of the paper": lambda folder: described(folder, "paper"),
    "a network's input and features": prepared,
    "loops": looped,
    "a map of label maps": queried,
}


@pytest.fixture(scope="module", params=JOBS)
def usual(request, tmp_path_factory):
    """A job, and its results by torch's usual default."""
    job = JOBS[request.param]
    return job, [*job(tmp_path_factory.mktemp("usual"))]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_the_default_dtype_changes_nothing(usual, dtype, tmp_path):
    job, expected = usual
    with default(dtype):
        results = job(tmp_path)
    for result, right in zip(results, expected, strict=True):
        if isinstance(right, torch.Tensor):
            assert result.dtype == right.dtype and torch.equal(result, right)
        else:
            assert result == right
