"""Features of a stream without torch, against those of the package."""

import numpy as np
import pytest
from ssrvlad_place.stream import SignMap
from test_signs import drive

from ssrvlad_torch.channels.live_signs import LiveSigns

SHAPE = (8, 3, 8)


def frames_of(count):
    """Signs of `SHAPE`."""
    signs = drive(2 * count).numpy()
    return np.concatenate((signs[:count], signs[count:]), axis=-1)


@pytest.fixture(params=["numpy 2", "numpy 1"], autouse=True)
def counting(request, monkeypatch):
    if request.param == "numpy 1":
        monkeypatch.delattr(np, "bitwise_count", raising=False)


@pytest.mark.parametrize("starts", [(), (1,), (20, 33)])
def test_scores_are_those_of_the_package(starts):
    """Over sequences, of which each has its own mean, and more rows than fit at first."""
    frames, ours, theirs = frames_of(70), SignMap(SHAPE), LiveSigns(SHAPE)
    for number, signs in enumerate(frames):
        if number in starts:
            ours.start_sequence()
            theirs.start_sequence()
        products = ours.products(signs)
        if number:
            got, expected = ours.scores(signs, products), theirs.scores(signs[None])
            assert got.dtype == np.float32
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)
        ours.append(signs, products)
        theirs.add(signs)


def test_equal_frames_have_finite_scores():
    (signs,), frames = frames_of(1), SignMap(SHAPE)
    for _ in range(3):
        products = frames.products(signs)
        assert np.isfinite(frames.scores(signs, products)).all()
        frames.append(signs, products)
