"""Bit-planes, and the stages on them against the reference, layer by layer: morphology, connected
regions, thinning, keypoints, centres."""

import kornia.morphology
import numpy as np
import pytest
import torch
from drawings import (
    BLOCK,
    CROSS,
    DOT,
    EMPTY,
    MASKS,
    RING,
    blobs,
    every_neighbourhood,
    mask,
    planes,
    random_planes,
)
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.config import CHOICES
from ssrvlad_torch.stages import bitplanes, skeleton
from ssrvlad_torch.stages.bitplanes import pack, unpack
from ssrvlad_torch.stages.centroid import centre_table, centroids
from ssrvlad_torch.stages.components import drop_regions, fill_holes
from ssrvlad_torch.stages.keypoints import end_points, intersections
from ssrvlad_torch.stages.morphology import dilate, erode, open_and_close
from ssrvlad_torch.stages.skeleton import RULES, zhang_suen


def test_pack_and_unpack_are_inverse():
    some = random_planes()
    layers = unpack(some)
    assert layers.shape == (3, 8, 13, 17)
    assert layers.dtype == torch.bool
    assert torch.equal(pack(layers), some)


def test_neighbours_are_clockwise_from_north_and_zero_outside():
    some = random_planes()
    padded = torch.nn.functional.pad(some, (1, 1, 1, 1))
    offsets = [(-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)]
    for plane, (dy, dx) in zip(bitplanes.neighbours(some), offsets, strict=True):
        assert torch.equal(plane, padded[:, 1 + dy : 14 + dy, 1 + dx : 18 + dx])


def test_two_or_more_is_set_where_two_planes_are():
    some = [random_planes(seed) for seed in range(4)]
    expected = sum(unpack(plane).int() for plane in some) >= 2
    assert torch.equal(unpack(bitplanes.two_or_more(some)), expected)


def test_points_are_the_set_pixels_by_layer_then_image_then_raster_order():
    some = random_planes()
    group, *places = bitplanes.points(some)
    layer, image, *expected = unpack(some).transpose(0, 1).nonzero(as_tuple=True)
    assert torch.equal(group, layer * 3 + image)
    assert all(map(torch.equal, places, expected))


def test_runs_of_a_ring_by_hand():
    group, *runs = bitplanes.runs(planes(mask(RING)))
    assert group.tolist() == [0] * 6
    expected = [(1, 1, 5), (2, 1, 1), (2, 5, 5), (3, 1, 1), (3, 5, 5), (4, 1, 5)]
    assert list(zip(*(each.tolist() for each in runs), strict=True)) == expected


def test_painting_all_runs_gives_the_planes_back():
    drawn = [planes(mask(drawing)) for drawing in MASKS.values()]
    for some in (random_planes(1), random_planes().transpose(1, 2), *drawn):
        assert torch.equal(bitplanes.paint(bitplanes.runs(some), some.shape), some)


def opened_and_closed(layer, radii):
    """``radii`` are two digits to the base 6: of the opening and of the closing."""
    opening, closing = divmod(radii, 6)
    opened = reference.dilate(reference.erode(layer, opening), opening)
    return reference.erode(reference.dilate(opened, closing), closing)


RADII, AREAS = (0, 1, 2, 7), (0, 1, 2, 3, 5, 40, 1000)
OF_BOTH = (1, 6, 15)
STAGES = {
    "dilate": (dilate, reference.dilate, RADII),
    "erode": (erode, reference.erode, RADII),
    "open and close": (lambda x, n: open_and_close(x, *divmod(n, 6)), opened_and_closed, OF_BOTH),
    "open and close by tensors": (
        lambda x, n: open_and_close(x, *map(torch.tensor, divmod(n, 6))),
        opened_and_closed,
        OF_BOTH,
    ),
    "fill holes": (fill_holes, lambda x, n: x | reference.small_holes(x, n), AREAS),
    "drop regions": (drop_regions, lambda x, n: x & ~reference.small_regions(x, n), AREAS),
    "zhang-suen": (
        lambda x, _: skeleton.thin(x, RULES["zhang-suen"]),
        lambda x, _: reference.thin(x, "zhang-suen"),
        (0,),
    ),
    "guo-hall": (
        lambda x, _: skeleton.thin(x, RULES["guo-hall"]),
        lambda x, _: reference.thin(x, "guo-hall"),
        (0,),
    ),
    "end points": (lambda x, _: end_points(x), lambda x, _: reference.end_points(x), (0,)),
    "intersections": (lambda x, _: intersections(x), lambda x, _: reference.intersections(x), (0,)),
}
"""By name the stage and the reference, called with masks and a radius or an area, and some of these
numbers."""
stages = pytest.mark.parametrize("stage", STAGES)
DRAWN = {name: planes(mask(drawing), ~mask(drawing)) for name, drawing in MASKS.items()} | {
    "every neighbourhood": every_neighbourhood(),
    "blobs": pack(
        torch.stack([torch.from_numpy(blobs(seed, 45, 61, 6) < 6) for seed in range(16)]).view(
            2, 8, 45, 61
        )
    ),
}


def assert_like_the_reference(stage, some, number):
    fast, plain, _ = STAGES[stage]
    before = some.clone()
    expected = [[plain(layer, number) for layer in layers] for layers in unpack(some).numpy()]
    np.testing.assert_array_equal(unpack(fast(some, number)), np.array(expected))
    assert torch.equal(some, before)


@stages
@pytest.mark.parametrize("name", DRAWN)
def test_drawn_masks_equal_the_reference(name, stage):
    for number in STAGES[stage][2]:
        assert_like_the_reference(stage, DRAWN[name], number)


@stages
@given(
    seed=st.integers(0, 10_000),
    height=st.integers(1, 24),
    width=st.integers(1, 24),
    number=st.integers(0, 35),
    density=st.sampled_from([0.25, 0.3, 0.5, 0.65, 0.75]),
)
def test_noise_equals_the_reference(stage, seed, height, width, number, density):
    """Near the percolation threshold regions are as winding as they get."""
    layers = np.random.default_rng(seed).random((1, 8, height, width)) < density
    number = number % 8 if STAGES[stage][2] is RADII else number
    assert_like_the_reference(stage, pack(torch.from_numpy(layers)), number)


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_dilation_is_kornias(radius):
    some = random_planes(3)
    kernel = torch.ones(2 * radius + 1, 2 * radius + 1)
    expected = kornia.morphology.dilation(unpack(some).float(), kernel)
    assert torch.equal(unpack(dilate(some, radius)), expected.bool())


@pytest.mark.parametrize("variant", CHOICES["thinning"])
@pytest.mark.parametrize("width", [7, 8, 9, 63, 64, 65])
def test_thinning_equals_the_reference_at_widths_around_a_word(variant, width):
    some = random_planes(width, (2, 33, width)) | random_planes(width + 1, (2, 33, width))
    assert_like_the_reference(variant, some, 0)


def words_of_sub_iterations(layer):
    """Words that each sub-iteration of thinning looks at."""
    work = []

    def counting(pixels, ring):
        work.append(pixels.numel())
        return zhang_suen(pixels, ring)

    skeleton.thin(planes(layer), counting)
    return work


def test_thinning_visits_only_pixels_that_may_still_change():
    """A small block beside a large one settles first; then nobody looks at it any more."""
    assert len(words_of_sub_iterations(mask(CROSS))) == 2
    assert 4 <= len(words_of_sub_iterations(mask(BLOCK))) <= 6
    layer = np.zeros((64, 512), bool)
    layer[2:62, 2:62] = layer[20:26, 500:506] = True
    work = words_of_sub_iterations(layer)
    assert len(work) > 40
    assert max(work) < layer.size / 100
    assert work[-3] < work[4]


@given(seed=st.integers(0, 10_000), height=st.integers(1, 20), width=st.integers(1, 20))
def test_centres_equal_the_reference(seed, height, width):
    some = random_planes(seed, (2, height, width)) & random_planes(seed + 3, (2, height, width))
    expected = [
        [reference.centroid(layer) or (-1, -1) for layer in layers]
        for layers in unpack(some).numpy()
    ]
    assert centre_table(centroids(some), 2).tolist() == np.array(expected).tolist()


def test_a_layer_without_pixels_has_no_centre():
    assert len(centroids(planes(mask(EMPTY))).group) == 0
    assert centre_table(centroids(planes(mask(DOT))), 1)[0, :2].tolist() == [[1, 2], [-1, -1]]


def test_a_centre_is_exact_where_float32_is_not():
    wide = torch.zeros(1, 2, 9001, dtype=torch.uint8)
    wide[0, 0, 4000:] = 1
    assert centre_table(centroids(wide), 1)[0, 0].tolist() == [0, 6500]
    assert np.float32(4000 + 9000) / 2 == 6500
