"""Regions of high energy: a hand-worked case, and the authors' way with scikit-image."""

import numpy as np
import pytest
import torch
from skimage.measure import label, regionprops

from ssrvlad_torch.baselines.regions import region_descriptors


def test_a_hand_worked_case():
    """Levels of the first map: a 5 alone (energy 5.5), two 2s that touch by a corner (2.35), a 1
    that touches them (1.9); what is below 1 is no region. The second map has one region of 3s."""
    maps = torch.tensor(
        [
            [[2.1, 0.9, 0.0], [1.9, 2.6, 0.0], [0.0, 0.0, 5.5]],
            [[0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 3.0, 3.0]],
        ]
    )
    expected = [[5.5, 3.0], [5.5, 6.0], [2.1 + 0.9 + 1.9 + 2.6, 1.0], [1.9, 0.0]]
    torch.testing.assert_close(region_descriptors(maps, 10), torch.tensor(expected))
    torch.testing.assert_close(region_descriptors(maps, 3), torch.tensor(expected[:3]))
    assert region_descriptors(torch.full((3, 4, 5), 0.9), 10).shape == (0, 3)


def authors_way(maps: np.ndarray, count: int) -> np.ndarray:
    """Every map is labelled, boxes are sorted by mean activation, columns summed over each box."""
    found = []
    for levels in maps:
        regions = regionprops(label(levels.astype(int)), intensity_image=levels)
        found += [(region.intensity_mean, region.bbox) for region in regions]
    found.sort(key=lambda entry: -entry[0])
    boxes = [maps[:, top:low, left:right] for _, (top, left, low, right) in found[:count]]
    return np.array([box.sum(axis=(1, 2)) for box in boxes])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scale", [1.5, 4, 40])
def test_the_authors_way(seed, scale):
    rng = np.random.default_rng(seed)
    maps = np.maximum(rng.normal(0, scale, (7, 13, 11)), 0).astype(np.float32)
    got = region_descriptors(torch.from_numpy(maps), 60)
    np.testing.assert_allclose(got.numpy(), authors_way(maps, 60), rtol=1e-5)


def test_scikit_image_cuts_fractions_off():
    """What the module's text says of the authors' program."""
    levels = np.array([[0.5, 1.2, 1.7], [0.0, 0.0, 2.2]])
    assert label(levels).tolist() == [[0, 1, 1], [0, 0, 2]]


def test_equal_energies_come_in_the_order_of_maps_rows_and_columns():
    maps = torch.zeros(40, 9, 9)
    maps[:, ::2, ::2] = 2
    marks = maps[:1] * torch.arange(81.0).reshape(1, 9, 9) / 2  # a map that tells the places
    found = region_descriptors(torch.cat([maps, marks / 100]), 300)
    place = (100 * found[:, -1]).round().long()
    expected = (maps > 0)[:12].nonzero()
    assert torch.equal(place, expected[:, 1] * 9 + expected[:, 2])
    assert len(expected) == len(found) == 300
