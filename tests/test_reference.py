"""The reference against hand-worked answers: everything else is held to it."""

import cv2
import numpy as np
import pytest
from drawings import MASKS, ROAD, SPACE, VOID, blobs, mask
from skimage.morphology import thin

from ssrvlad_torch import SSRVLADConfig, reference

PLAIN = {
    "empty": "..... .....",
    "line": "....... .#####. .......",
    "diagonal": "#.... .#... ..#.. ...#. ....#",
    "tee": "......... .#######. ....#.... ....#.... ....#....",
    "block": "........ .######. .######. .######. .######. ........",
}
DRAWN = {name.lower(): mask(drawing) for name, drawing in (MASKS | PLAIN).items()}
PLAIN = SSRVLADConfig.from_preset(
    "paper", labels_as=SPACE, closing=0.0, hole_area=0.0, region_area=0.0
)


SHAPES = [*DRAWN.values(), *(blobs(seed, 41, 57, grain=9) < 5 for seed in range(12))]


@pytest.mark.parametrize("layer", SHAPES)
def test_zhang_suen_is_opencv_on_a_padded_mask(layer):
    padded = np.pad(layer, 2).astype(np.uint8) * 255
    expected = cv2.ximgproc.thinning(padded, thinningType=cv2.ximgproc.THINNING_ZHANGSUEN)
    expected = expected[2:-2, 2:-2] > 0
    np.testing.assert_array_equal(reference.thin(layer, "zhang-suen"), expected)


@pytest.mark.parametrize("layer", SHAPES)
def test_guo_hall_is_that_of_scikit_image(layer):
    np.testing.assert_array_equal(reference.thin(layer, "guo-hall"), thin(layer))


@pytest.mark.parametrize(
    ("name", "ends", "intersections"),
    [
        ("line", [[1, 1], [1, 5]], []),
        ("dot", [[1, 2]], []),
        ("empty", [], []),
        ("diagonal", [[0, 0], [4, 4]], []),
        ("cross", [[0, 3], [3, 0], [3, 6], [6, 3]], [[3, 3]]),
        ("tee", [[1, 1], [1, 7], [4, 4]], [[1, 4]]),  # the pixels beside it have crossing number 2
    ],
)
def test_keypoints_of_drawings_equal_those_by_hand(name, ends, intersections):
    assert np.argwhere(reference.end_points(DRAWN[name])).tolist() == ends
    assert np.argwhere(reference.intersections(DRAWN[name])).tolist() == intersections


def test_touching_intersections_keep_the_first_in_raster_order():
    crossing = mask(".#...#. .#...#. ####### .#...#. .##.##.")
    remaining = reference.intersections(crossing)
    for y, x in np.argwhere(remaining):
        around = remaining[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
        assert around.sum() == 1
    assert reference.intersections(DRAWN["crowded_crossing"]).sum() == 1


@pytest.mark.parametrize(
    ("name", "centre"), [("dot", (1, 2)), ("line", (1, 3)), ("block", (3, 4)), ("empty", None)]
)
def test_centre_is_the_rounded_centroid(name, centre):
    """The centre of the block is between pixels: halves go up."""
    assert reference.centroid(DRAWN[name]) == centre


def test_holes_are_enclosed_and_small():
    holes = reference.small_holes(DRAWN["holes"], 4)
    assert np.argwhere(holes).tolist() == [[2, 5], [3, 6]]  # not joined: holes are 4-connected
    assert reference.small_holes(DRAWN["holes"], 5).sum() == 6
    assert not reference.small_holes(DRAWN["holes"], 1).any()


def test_regions_are_8_connected():
    specks = reference.small_regions(DRAWN["specks"], 3)
    assert specks.sum() == 5
    assert reference.small_regions(DRAWN["specks"], 5).sum() == 13


def test_the_shape_context_of_five_points_by_hand():
    """Limits 1, 4, 9: one point in each of three places, one on the point itself, one too far."""
    context = np.array([[5, 5], [5, 6], [7, 5], [5, 2], [5, 9]])
    histogram = reference.shape_context((5, 5), context, (1, 4, 9), sectors=4)
    expected = np.zeros((3, 4), int)
    expected[0, 0] = 1  # right, distance 1
    expected[1, 1] = 1  # down, distance 2
    expected[2, 2] = 1  # left, distance 3
    np.testing.assert_array_equal(histogram, expected)


def test_axes_and_diagonals_begin_their_sector():
    offsets = [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)]
    for sectors, step, chosen in ((12, 3, offsets[::2]), (8, 1, offsets)):
        for number, offset in enumerate(chosen):
            histogram = reference.shape_context((0, 0), np.array([offset]), (2,), sectors)
            assert histogram[0, number * step] == 1


def test_of_equal_votes_the_lowest_category_wins():
    categories = np.array([[3, 3, 1, 2], [3, 0, 2, 1]])
    assert reference.reduce_by_majority(categories, (1, 2)).tolist() == [[3, 1]]


def test_a_cross_describes_itself_by_hand():
    """A cross of 13 pixels: five keypoints, of which the centre's histogram is subtracted."""
    labels = np.where(DRAWN["cross"], ROAD, VOID)
    traces = [reference.trace(layer, PLAIN) for layer in reference.layers_of(labels, PLAIN)]
    trace, histograms = traces[0], reference.residuals(traces, PLAIN).histograms
    assert trace.centre == (3, 3)
    assert len(np.argwhere(trace.end_points | trace.intersections)) == 5
    limits = PLAIN.ring_limits(7, 7)
    assert limits == (0, 0, 1, 6, 24)
    assert histograms["centre"][0].sum(axis=1).tolist() == [0, 0, 4, 4, 4]
    ends_see = 4 + 6  # along their own arm up to R, and of the other arm
    assert histograms["points"][0].sum() == 12 + 4 * ends_see
    assert not histograms["points"][1:].any()


def test_a_street_bending_right_has_its_vanishing_column_there():
    """Openness of the columns in 64ths: 0, 16 and 64; only the last has weight to speak of."""
    layers = np.zeros((8, 4, 9), bool)
    layers[0, 3, 2:4] = True  # ground in a quarter of two columns
    layers[5, :, 7] = True  # sky over all of one
    weights = [0, 0, 16, 16, 0, 0, 0, 2**20, 0]
    weights[2] = weights[3] = 16**8 >> 28
    moment = sum(w * 2 * (x - 4) for x, w in enumerate(weights))
    total = sum(weights) + 9 * 2**20 // 20
    assert reference.vanishing_column(list(layers)) == round(moment / (2 * total)) == 2
    assert reference.vanishing_column(list(np.zeros((8, 4, 9), bool))) == 0


def test_cells_hold_the_fraction_that_is_covered():
    layer = np.zeros((12, 16), bool)  # every pixel is 2 x 2 cells
    layer[0, 0] = layer[11, 15] = True
    cells = reference.pool(layer, 0)
    assert cells[:2, :2].tolist() == cells[-2:, -2:].tolist() == [[1, 1], [1, 1]]
    assert cells.sum() == 8
    assert reference.pool(layer, 1).sum() == 4  # one pixel left it


def test_basis_functions_are_orthogonal_and_start_with_a_constant():
    config = SSRVLADConfig(spectral_weight=0.0)
    table = np.array(reference.basis(config, 114)).reshape(114, -1)
    np.testing.assert_allclose(table @ table.T, np.eye(114), atol=1e-12)
    np.testing.assert_allclose(table[0], 120**-0.5)
