"""Bit-planes, and the stages against the reference, layer by layer, and against
what is worked by hand."""

import kornia.morphology
import numpy as np
import pytest
import torch
from drawings import pack, random_planes
from exported import in_onnxruntime, in_openvino
from helpers import refuses
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.config import AREA_LAYERS
from ssrvlad_torch.deployment.trace import traced
from ssrvlad_torch.stages import shape_context
from ssrvlad_torch.stages.bitplanes import points, unpack
from ssrvlad_torch.stages.boundaries import DIRECTIONS, boundaries
from ssrvlad_torch.stages.centroid import centre_table, centroids
from ssrvlad_torch.stages.layers import UNKNOWN, categorise, category_table, refuse_unknown
from ssrvlad_torch.stages.lengths import lengths
from ssrvlad_torch.stages.morphology import dilate, open_and_close
from ssrvlad_torch.stages.reduction import reduce_by_majority
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts
from ssrvlad_torch.stages.vanishing_column import vanishing_columns
from ssrvlad_torch.taxonomy import label_space, label_space_names


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_dilation_is_kornias(radius):
    bits = random_planes(3)
    kernel = torch.ones(2 * radius + 1, 2 * radius + 1)
    expected = kornia.morphology.dilation(unpack(bits).float(), kernel)
    assert torch.equal(unpack(dilate(bits, radius)), expected.bool())


@given(seed=st.integers(0, 10_000), opening=st.integers(0, 5), closing=st.integers(0, 5))
def test_radii_that_are_tensors_open_and_close_as_in_the_reference(seed, opening, closing):
    layers = np.random.default_rng(seed).random((8, 23, 17)) < 0.5
    planes = open_and_close(pack(layers[None]), torch.tensor(opening), torch.tensor(closing))
    opened = [reference.dilate(reference.erode(layer, opening), opening) for layer in layers]
    closed = [reference.erode(reference.dilate(layer, closing), closing) for layer in opened]
    np.testing.assert_array_equal(unpack(planes)[0], np.array(closed))


def test_a_centre_is_exact_where_float32_is_not():
    wide = torch.zeros(1, 2, 9001, dtype=torch.uint8)
    wide[0, 0, 4000:] = 1
    assert centre_table(centroids(wide), 1)[0, 0].tolist() == [0, 6500]
    assert np.float32(4000 + 9000) / 2 == 6500


def by_direction(drawing: np.ndarray) -> dict[str, int]:
    numbers = torch.from_numpy(np.where(drawing, 3, AREA_LAYERS))[None]
    return dict(zip(DIRECTIONS, boundaries(numbers).sum((0, 2, 3)).tolist(), strict=True))


def test_a_straight_boundary_is_two_pixels_wide():
    half = np.zeros((10, 12), bool)
    half[:, 6:] = True
    assert by_direction(half) == {"upright": 16, "level": 0, "rising": 0, "falling": 0}
    assert by_direction(half[:, ::-1]) == by_direction(half) == by_direction(~half)
    assert by_direction(half.T) == {"upright": 0, "level": 16, "rising": 0, "falling": 0}


@pytest.mark.parametrize("name", label_space_names())
def test_every_id_goes_to_its_category(name):
    space = label_space(name)
    labels = torch.tensor([[[label.id for label in space.classes]]])
    categories = categorise(labels, *category_table(space))
    assert categories.tolist() == [[[label.category_index for label in space.classes]]]


@pytest.mark.parametrize(
    ("unknown", "dtype"),
    [
        *((number, torch.int64) for number in (-1, 12, 255, -(2**40), 2**62)),
        *((2**32 - 1, torch.uint32), (2**64 - 1, torch.uint64), (2**32 + 3, torch.uint64)),
    ],
)
def test_an_unknown_id_is_named_with_its_count_and_the_space(unknown, dtype):
    """Large unsigned ids do not wrap into known ones."""
    space = label_space("camvid-11")
    labels = torch.tensor([[[3, unknown], [unknown, 5]]], dtype=dtype)
    categories = categorise(labels, *category_table(space))
    assert (categories == UNKNOWN).tolist() == [[[False, True], [True, False]]]
    named = rf"label id {unknown} \(2 pixels\) is not in label space camvid-11; expected 0 to 11"
    refuses(named, refuse_unknown, labels, space)
    with pytest.raises(ValueError, match=r"label id 20 \(1 pixel\) is not .*, like 2 more"):
        refuse_unknown(torch.tensor([[[20, 21, 40, 21]]]), space)


SKY = 5
IN_PIXELS = SSRVLADConfig.from_preset("paper", opening=0.033333, closing=0.25, hole_area=0.123456)
HUGE = [(1, 1), (1, 40_000), (719, 1281), (6000, 4000), (10_007, 9973), (30_000, 30_000)]


class OfSizes(torch.nn.Module):
    """A function of the lengths of two lines."""

    def __init__(self, function) -> None:
        super().__init__()
        self.function = function

    def forward(self, rows: torch.Tensor, columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.function(rows.shape[0], columns.shape[0])


def test_lengths_in_a_graph_are_those_of_the_config():
    def numbers(height, width):
        *sizes, limits = lengths(IN_PIXELS, height, width)
        return tuple(map(torch.as_tensor, (*sizes, *limits)))

    examples = {"rows": (torch.zeros(7), "H"), "columns": (torch.zeros(5), "W")}
    model = traced(OfSizes(numbers), examples, {f"n{n}": [] for n in range(4 + IN_PIXELS.rings)})
    for run in (in_onnxruntime(model), in_openvino(model)):
        for size in (*HUGE, *np.random.default_rng(0).integers(1, 30_000, (100, 2)).tolist()):
            got = run(*(np.zeros(length, np.float32) for length in size))
            assert [*map(int, got)] == [*map(int, numbers(*size))]


@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 50), st.floats(0, 1))
def test_vanishing_columns_equal_the_reference(seed, height, width, density):
    """Also in float32, which is what exported files compute in."""
    rng = np.random.default_rng(seed)
    numbers = rng.integers(0, AREA_LAYERS + 1, (2, height, width))
    numbers[rng.random(numbers.shape) < density] = SKY
    result = vanishing_columns(torch.from_numpy(numbers))
    assert result.dtype == torch.int64
    layers = [[image == k for k in range(AREA_LAYERS)] for image in numbers]
    assert result.tolist() == [reference.vanishing_column(image) for image in layers]
    assert (2 * result.abs() <= width).all()


def test_large_images_do_not_overflow():
    numbers = torch.full((1, 3000, 5000), SKY)
    numbers[:, :, :4000] = AREA_LAYERS
    weight, pull = 1000 * 2**20, 5000 * 2**20 // 20
    assert int(vanishing_columns(numbers)) == round(weight * (4499.5 - 2499.5) / (weight + pull))


@pytest.mark.parametrize(("rows", "winner"), [(151, 7), (150, 8)])
def test_the_majority_of_a_large_cell_counts_every_pixel(rows, winner):
    layers = torch.full((1, 301, 299), 8, dtype=torch.int32)
    layers[0, :rows] = 7
    assert reduce_by_majority(layers, (1, 1)).item() == winner


# ---- shape_context


CPU = torch.device("cpu")


@pytest.mark.parametrize("pairs", [1000, 997])
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (13, 101)])
def test_chunks_count_what_one_list_counts(monkeypatch, size, pairs):
    pixels = random_planes(14, (2, *size))
    ends = points(pixels & random_planes(15, (2, *size)))
    bins = log_polar_bins(*size, (4, 40, 400), 12, CPU)
    whole = shape_contexts(ends, points(pixels), bins, 2)
    monkeypatch.setattr(shape_context, "PAIRS_AT_ONCE", pairs)
    assert torch.equal(shape_contexts(ends, points(pixels), bins, 2), whole)
