import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.stages.grid_pooling import COLUMNS, ROWS, overlaps, pool


@given(
    st.integers(0, 10_000),
    st.integers(1, 60),
    st.integers(1, 80),
    st.lists(st.integers(-90, 90), min_size=1, max_size=3),
)
def test_equals_the_reference_exactly(seed, height, width, shift):
    layers = np.random.default_rng(seed).random((len(shift), 8, height, width)) < 0.4
    cells = pool(torch.from_numpy(layers), torch.tensor(shift))
    assert cells.dtype == torch.float64
    assert cells.shape == (len(shift), 8, ROWS, COLUMNS)
    expected = [
        [reference.pool(layer, s) for layer in image]
        for image, s in zip(layers, shift, strict=True)
    ]
    np.testing.assert_array_equal(cells.numpy(), expected)


@given(st.integers(1, 200), st.integers(1, 40))
def test_overlaps_cut_every_pixel_into_whole_parts(pixels, cells):
    parts = overlaps(pixels, cells, torch.zeros(1, dtype=torch.int64))[0]
    assert (parts.sum(0) == pixels).all()
    assert (parts.sum(1) == cells).all()
