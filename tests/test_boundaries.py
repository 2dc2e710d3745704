import numpy as np
import pytest
import torch
from drawings import HOLES, mask
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.bitplanes import pack, unpack
from ssrvlad_torch.stages.boundaries import DIRECTIONS, boundaries


def found(layers: torch.Tensor) -> torch.Tensor:
    """``(B, 4, H, W)`` of ``(B, 8, H, W)`` bool."""
    planes = boundaries(pack(layers))
    assert not (planes >> len(DIRECTIONS)).any()
    return unpack(planes)[:, : len(DIRECTIONS)]


@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 20),
    width=st.integers(1, 40),
    density=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
)
def test_equal_the_reference(seed, height, width, density):
    layers = np.random.default_rng(seed).random((2, 8, height, width)) < density
    got = found(torch.from_numpy(layers))
    expected = [reference.boundaries(list(image)) for image in layers]
    np.testing.assert_array_equal(got.numpy(), np.array(expected))


def counts(drawing: np.ndarray) -> dict[str, int]:
    layers = torch.zeros(1, 8, *drawing.shape, dtype=torch.bool)
    layers[0, 3] = torch.from_numpy(drawing.copy())
    return dict(zip(DIRECTIONS, found(layers).sum((0, 2, 3)).tolist(), strict=True))


def test_a_straight_boundary_is_two_pixels_wide():
    half = np.zeros((10, 12), bool)
    half[:, 6:] = True
    assert counts(half) == {"upright": 16, "level": 0, "rising": 0, "falling": 0}
    assert counts(half[:, ::-1]) == counts(half) == counts(~half)
    assert counts(half.T) == {"upright": 0, "level": 16, "rising": 0, "falling": 0}


def test_the_mirror_image_of_a_slanting_boundary_has_the_other_direction():
    rows, columns = np.indices((9, 9))
    rising = rows + columns < 9  # its boundary goes up to the right
    drawn = counts(rising)
    assert drawn["rising"] > 2 * drawn["falling"]
    assert drawn == counts(~rising)
    mirrored = {"rising": "falling", "falling": "rising"}
    expected = {mirrored.get(name, name): count for name, count in drawn.items()}
    assert counts(rising[:, ::-1]) == expected


def test_two_layers_that_meet_are_one_boundary():
    layers = torch.zeros(1, 8, 10, 12, dtype=torch.bool)
    layers[0, 4, :, 6:] = True
    alone = found(layers)
    layers[0, 2, :, :6] = True
    assert torch.equal(found(layers), alone)


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (9, 2), (3, 3)])
def test_small_and_full_images_have_none(size):
    for layers in (torch.zeros(1, 8, *size).bool(), torch.ones(1, 8, *size).bool()):
        assert not found(layers).any()


def test_the_edge_of_the_image_is_no_boundary():
    inside = mask(HOLES)
    masks = found(torch.from_numpy(np.broadcast_to(inside, (1, 8, *inside.shape)).copy()))
    assert not masks[..., [0, -1], :].any()
    assert not masks[..., [0, -1]].any()
