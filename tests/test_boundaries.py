import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.config import AREA_LAYERS as NONE
from ssrvlad_torch.stages.boundaries import DIRECTIONS, boundaries


def found(numbers: torch.Tensor) -> torch.Tensor:
    """``(B, 4, H, W)`` bool of ``(B, H, W)`` numbers of layers."""
    masks = boundaries(numbers)
    assert masks.shape == (len(numbers), len(DIRECTIONS), *numbers.shape[1:])
    assert ((masks == 0) | (masks == 1)).all()
    return masks.bool()


@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 20),
    width=st.integers(1, 40),
    kinds=st.integers(1, NONE + 1),
)
def test_equal_the_reference(seed, height, width, kinds):
    numbers = NONE - np.random.default_rng(seed).integers(0, kinds, (2, height, width))
    expected = [reference.boundaries([image == k for k in range(NONE)]) for image in numbers]
    np.testing.assert_array_equal(found(torch.from_numpy(numbers)).numpy(), np.array(expected))


def counts(drawing: np.ndarray) -> dict[str, int]:
    numbers = torch.from_numpy(np.where(drawing, 3, NONE))[None]
    return dict(zip(DIRECTIONS, found(numbers).sum((0, 2, 3)).tolist(), strict=True))


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
