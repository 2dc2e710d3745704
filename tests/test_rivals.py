import numpy as np
import pytest
import torch
from core import chance_of

from ssrvlad_torch.native.headers import place_model

ELSEWHERE = int(place_model()["elsewhere"])


def chance_maps(rows: int, smooth: int, count: int = 4000) -> np.ndarray:
    """The chances of the best of rows that are all chance, each like those around it."""
    generator = torch.Generator().manual_seed(0)
    kernel = torch.hann_window(smooth + 2, periodic=False)[None, None, 1:-1]
    noise = torch.randn(count, 1, rows + smooth - 1, generator=generator)
    return np.array([chance_of(values).chance for values in torch.conv1d(noise, kernel)[:, 0]])


@pytest.mark.parametrize("smooth", [1, 7])
@pytest.mark.parametrize("rows", [60, 150, 1000])
def test_the_chance_of_a_wrong_answer_is_uniform(rows, smooth):
    """Whatever the size of the map, and however like one another its frames are."""
    chances = chance_maps(rows, smooth)
    for bound, most in ((0.5, 0.60), (0.1, 0.135), (0.01, 0.0165)):
        assert (chances < bound).mean() < most
    assert (chances < 0.5).mean() > 0.4 and (chances < 0.1).mean() > 0.06


@pytest.mark.parametrize("ahead", [4.0, 6.0])
def test_a_right_answer_is_hardly_chance(ahead):
    generator = torch.Generator().manual_seed(1)
    rows = torch.randn(500, 150, generator=generator)
    rows[:, 70] = ahead
    chances = np.array([chance_of(values).chance for values in rows])
    assert np.median(chances) < (0.1 if ahead < 5 else 0.01)


def test_places_are_peaks_that_are_apart():
    values = torch.zeros(60)
    values[[10, 11, 12, 40]] = torch.tensor([3.0, 5, 4, 2])
    assert chance_of(values).rival == 40
    values[11 + ELSEWHERE] = 2.5
    assert chance_of(values).rival == 40
    values[12 + ELSEWHERE] = 2.5
    assert chance_of(values).rival == 12 + ELSEWHERE
    rows = torch.tensor([3, 10, 11, 30])
    assert chance_of(torch.tensor([1.0, 5, 4, 2]), rows).rival == 30


def test_the_chance_of_some_rows_is_that_of_all():
    values = torch.randn(300, generator=torch.Generator().manual_seed(3))
    rows = values.topk(100).indices.sort().values
    assert chance_of(values[rows], rows, 300) == chance_of(values)
