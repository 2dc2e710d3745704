import numpy as np
import pytest
import torch
from graphs import session
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from ssrvlad_torch import reference
from ssrvlad_torch.deployment.trace import traced
from ssrvlad_torch.stages.features import ROWS, SHAPE, SIGNS, Features, projections

SIZES = [(24, 32), (13, 40), (5, 3), (72, 96)]


def activations(seed, channels=20, size=(24, 32), count=1):
    generator = torch.Generator().manual_seed(seed)
    smooth = torch.rand(count, channels, 6, 8, generator=generator)
    large = nn.functional.interpolate(smooth, size, mode="bilinear")
    return large + 0.1 * torch.rand(large.shape, generator=generator)


def bits(signs):
    return np.unpackbits(np.asarray(signs), axis=-1, bitorder="little")


@pytest.mark.parametrize("size", SIZES)
@given(st.integers(0, 1000))
def test_has_the_signs_of_the_reference(size, seed):
    first, second = activations(seed, 20, size), activations(seed + 1, 7, (9, 9))
    signs = Features([20, 7])(first, second)
    assert signs.shape == (1, *SHAPE) and signs.dtype == torch.uint8
    expected = reference.features([first[0].double().numpy(), second[0].double().numpy()])
    assert (bits(signs[0]) != bits(expected)).mean() < 1e-3


def test_projections_are_those_of_the_reference():
    expected = [
        [[reference.random_side((r * SIGNS + k) * 5 + c) for k in range(SIGNS)] for c in range(5)]
        for r in range(ROWS)
    ]
    assert torch.equal(projections(5), torch.tensor(expected, dtype=torch.float32))
    published = (0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F, 0xF88BB8A8724C81EC)
    sides = [-1 if each >> 63 else 1 for each in published]  # from seed 0
    assert [reference.random_side(n) for n in range(4)] == sides


def test_light_and_contrast_of_a_channel_change_nothing():
    raw, gain = activations(0), torch.linspace(0.5, 3, 20)[:, None, None]
    changed = raw * gain + gain.flip(0)
    module = Features([20])
    assert (bits(module(raw)) != bits(module(changed))).mean() < 1e-3


def test_a_mirrored_picture_has_mirrored_cells():
    raw = activations(0)
    cells, mirrored = bits(Features([20])(raw)), bits(Features([20])(raw.flip(3)))
    assert (mirrored != cells[:, ::-1]).mean() < 1e-3


def test_a_picture_moved_by_a_column_has_moved_cells():
    """Signs change a little: channels are normalised over other cells."""
    wide = activations(0, size=(32, 68))
    left, right = (bits(Features([20])(wide[..., first : first + 64])) for first in (0, 4))
    assert (left[:, 1:] != right[:, :-1]).mean() < 0.1
    assert (left[:, :, 1:] != right[:, :, :-1]).mean() > 0.3


def test_near_activations_share_more_signs_than_others():
    raw, other = activations(0), activations(1)
    noisy = raw + 0.1 * torch.rand(raw.shape)
    here, near, far = (bits(Features([20])(each)) for each in (raw, noisy, other))
    assert (here != near).mean() < 0.3
    assert (here != far).mean() > 0.4


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (torch.zeros(1, 20, 24, 32), "the activations of the network are the same everywhere"),
        (torch.full((1, 20, 24, 32), torch.nan), "are not finite"),
        (torch.rand(1, 19, 24, 32), r"of \[20\] channels, got \(1, 19, 24, 32\)"),
        (torch.rand(1, 20, 24), r"got \(1, 20, 24\)"),
        (torch.rand(3, 20, 24, 32).index_fill(0, torch.tensor(1), 2), "the same everywhere"),
    ],
)
def test_refuses_other_activations(given, message):
    """Also of one picture of a batch."""
    with pytest.raises(ValueError, match=message):
        Features([20])(given)


def test_a_constant_channel_counts_for_nothing():
    raw = activations(0)
    raw[:, 3] = 7
    expected = reference.features([raw[0].double().numpy()])
    assert (bits(Features([20])(raw)[0]) != bits(expected)).mean() < 1e-3


def test_is_traced_with_free_axes_and_gives_zeros_where_eager_raises():
    module, axes = Features([20]).eval(), ("B", 20, "h", "w")
    example = activations(0, size=(23, 45), count=2)
    model = traced(module, {"a": (example, axes)}, {"features": ("B", *SHAPE)})
    assert {each.domain for each in model.graph.node} == {""}
    run = session(model.SerializeToString()).run
    for size in ((24, 32), (31, 17)):
        raw = activations(5, size=size, count=5)
        bad = raw[2:]
        bad[0], bad[1], bad[2, 5, 0, 0] = 0, 7, torch.nan
        [signs] = run(["features"], {"a": raw.numpy()})
        assert signs.dtype == np.uint8
        assert (bits(signs[:2]) != bits(module(raw[:2]))).mean() < 1e-3
        assert not signs[2:].any()
