import numpy as np
import pytest
import torch
from exported import session
from helpers import refuses
from torch import nn

from ssrvlad_torch import reference
from ssrvlad_torch.deployment.trace import traced
from ssrvlad_torch.stages import features as stage
from ssrvlad_torch.stages.features import (
    SHAPE,
    Features,
    cell_means,
    projections,
    unit_cells,
)

SIZES = [(24, 32), (13, 40), (5, 3), (72, 96)]


def activations(seed, channels=20, size=(24, 32), count=1):
    generator = torch.Generator().manual_seed(seed)
    smooth = torch.rand(count, channels, 6, 8, generator=generator)
    large = nn.functional.interpolate(smooth, size, mode="bilinear")
    return large + 0.1 * torch.rand(large.shape, generator=generator)


def bits(signs):
    return np.unpackbits(np.asarray(signs), axis=-1, bitorder="little")


NOISE = activations(100, count=3)
OF_20 = Features(NOISE)


@pytest.mark.parametrize("size", SIZES)
def test_has_the_signs_of_the_reference(size):
    """Of two activations, and of more channels than signs."""
    for seed, channels in ((0, (20, 7)), (1, (150,))):
        noise = [activations(seed + n, count, count=2) for n, count in enumerate(channels)]
        values = [activations(seed + n + 9, count, size) for n, count in enumerate(channels)]
        signs = Features(*noise)(*values)
        assert signs.shape == (1, *SHAPE) and signs.dtype == torch.uint8
        pictures = [[level[n].double().numpy() for level in noise] for n in range(2)]
        expected = reference.features([level[0].double().numpy() for level in values], pictures)
        assert (bits(signs[0]) != bits(expected)).mean() < 1e-3


def test_random_sides_are_those_of_the_reference():
    assert stage.random_sides(99).tolist() == [reference.random_side(n) for n in range(99)]
    published = (0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F, 0xF88BB8A8724C81EC)
    assert stage.random_numbers(4).tolist() == [*published]  # from seed 0
    assert stage.random_numbers(3, 1).tolist() == [*published[1:]]


def test_projections_do_not_depend_on_the_signs_of_the_components(monkeypatch):
    """Which libraries choose as they like."""
    cells, eigh = unit_cells([cell_means(activations(0, 30, count=3))]), torch.linalg.eigh
    expected = projections(cells)

    def other(matrix):
        variances, components = eigh(matrix)
        return variances, components * stage.random_sides(30)

    monkeypatch.setattr(torch.linalg, "eigh", other)
    torch.testing.assert_close(projections(cells), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (torch.zeros(1, 20, 24, 32), "the activations of the network are the same everywhere"),
        (torch.full((1, 20, 24, 32), torch.nan), "are not finite"),
        (torch.rand(3, 20, 24, 32).index_fill(0, torch.tensor(1), 2), "the same everywhere"),
    ],
)
def test_refuses_other_activations(values, message):
    """Also of one picture of a batch."""
    refuses(message, OF_20, values)


def test_is_traced_with_free_axes_and_gives_zeros_where_eager_raises():
    module, axes = OF_20.eval(), ("B", 20, "h", "w")
    example = activations(0, size=(23, 45), count=2)
    model = traced(module, {"a": (example, axes)}, {"features": ("B", *SHAPE)})
    assert {level.domain for level in model.graph.node} == {""}
    run = session(model.SerializeToString()).run
    for size in ((24, 32), (31, 17)):
        raw = activations(5, size=size, count=5)
        bad = raw[2:]
        bad[0], bad[1], bad[2, 5, 0, 0] = 0, 7, torch.nan
        [signs] = run(["features"], {"a": raw.numpy()})
        assert signs.dtype == np.uint8
        assert (bits(signs[:2]) != bits(module(raw[:2]))).mean() < 1e-3
        assert not signs[2:].any()
