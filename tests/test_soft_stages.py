"""The stages of the twin: on zeros and ones what the hard stages give, and gradients everywhere."""

import numpy as np
import pytest
import torch
from drawings import MASKS, SPACE, blobs, mask
from helpers import street
from scipy import ndimage
from torch import Tensor

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.bitplanes import count_points, pack, points, unpack
from ssrvlad_torch.soft.stages.boundaries import soft_boundaries
from ssrvlad_torch.soft.stages.centroid import soft_centroids, soft_points
from ssrvlad_torch.soft.stages.grid_pooling import soft_pool
from ssrvlad_torch.soft.stages.harmonics import safe_root, soft_coefficients
from ssrvlad_torch.soft.stages.keypoints import soft_end_points, soft_intersections, soft_keypoints
from ssrvlad_torch.soft.stages.layers import are_probabilities, membership, soft_layers, soft_merge
from ssrvlad_torch.soft.stages.morphology import soft_dilate, soft_erode, soft_open_and_close
from ssrvlad_torch.soft.stages.reduction import soft_majority
from ssrvlad_torch.soft.stages.regions import soft_regions
from ssrvlad_torch.soft.stages.residuals import soft_aggregate
from ssrvlad_torch.soft.stages.shape_context import bin_masks, soft_shape_contexts
from ssrvlad_torch.soft.stages.skeleton import COARSE, eroded_skeleton, soft_skeleton
from ssrvlad_torch.soft.stages.vanishing_column import soft_vanishing_columns
from ssrvlad_torch.stages.boundaries import boundaries
from ssrvlad_torch.stages.centroid import centre_table, centroids
from ssrvlad_torch.stages.components import drop_regions, fill_holes
from ssrvlad_torch.stages.grid_pooling import pool
from ssrvlad_torch.stages.harmonics import basis_table, bin_table, coefficients, soft_histograms
from ssrvlad_torch.stages.keypoints import end_points, intersections
from ssrvlad_torch.stages.layers import categorise, category_table, merge, split
from ssrvlad_torch.stages.morphology import open_and_close
from ssrvlad_torch.stages.reduction import reduce_by_majority
from ssrvlad_torch.stages.residuals import aggregate
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts
from ssrvlad_torch.stages.skeleton import thin, zhang_suen
from ssrvlad_torch.stages.vanishing_column import vanishing_columns
from ssrvlad_torch.taxonomy import NO_LAYER, label_space

CPU = torch.device("cpu")
SIZE = 6, 7
MEMBERS = membership(label_space(SPACE), 12)
CELLS = 3, 4
BINS = bin_table(CELLS, 2, 4, 0.5, 0.5)
BASIS = basis_table(2, 4, 3, 1.0)
HALF = torch.rand(1, 8, *SIZE, generator=torch.Generator().manual_seed(1)) < 0.5
OTHER = torch.rand(1, 8, *SIZE, generator=torch.Generator().manual_seed(2)) < 0.5
MASKS_OF_HALF = bin_masks(*SIZE, (4, 16), 4, 0.5, torch.float64, CPU)


def masks(softness: float, size: tuple[int, int] = SIZE, sectors: int = 4) -> Tensor:
    """``(2 * M, 2h, 2w)``."""
    found = bin_masks(*size, (4, 16), sectors, softness, torch.float64, CPU)
    return found.to_dense().view(-1, 2 * size[0], 2 * size[1])


STAGES = {
    "reduction": lambda x: soft_majority(x / 8, (3, 4), 0.7),
    "dilation": lambda x: soft_dilate(x, 1),
    "erosion": lambda x: soft_erode(x, 2),
    "opening and closing": lambda x: soft_open_and_close(x, 1, 1),
    "regions": lambda x: soft_regions(x, HALF, OTHER),
    "eroded skeleton": eroded_skeleton,
    "skeleton": lambda x: soft_skeleton(x, HALF, 0.3),
    "end points": lambda x: soft_end_points(x / 4),
    "intersections": soft_intersections,
    "keypoints": lambda x: soft_keypoints(x / 2),
    "centroid": soft_centroids,
    "centres": lambda x: soft_points(soft_centroids(x), *SIZE),
    "shape context": lambda x: soft_shape_contexts(x, x.flip(-1), MASKS_OF_HALF),
    "aggregation": lambda x: soft_aggregate(x.flatten(2)),
    "vanishing column": lambda x: soft_vanishing_columns(x / 3),
    "grid pooling": lambda x: soft_pool(x, x.sum((1, 2, 3)) / 99, CELLS),
    "harmonics": lambda x: soft_coefficients(
        soft_pool(x[:, :6], x.new_zeros(1), CELLS),
        soft_pool(x[:, 4:].flip(-1), x.new_zeros(1), CELLS),
        BINS,
        BASIS,
        (3, 2),
        0.75,
    ),
    "boundaries": soft_boundaries,
}


def layers_of(labels: np.ndarray) -> Tensor:
    """``(1, h, w)`` bit-planes of a label map."""
    table, origin = category_table(label_space(SPACE))
    return split(categorise(torch.from_numpy(labels)[None], table, origin))


def one_hot(labels: np.ndarray) -> Tensor:
    """``(1, 12, h, w)`` float64."""
    return torch.eye(12).double()[torch.from_numpy(labels).long()].permute(2, 0, 1)[None]


def drawn() -> list[Tensor]:
    """Each drawing, and random blobs, as ``(1, h, w)`` bit-planes."""
    drawings = [
        pack(torch.from_numpy(mask(drawing))[None, None].expand(1, 8, -1, -1))
        for drawing in MASKS.values()
    ]
    return drawings + [layers_of(blobs(seed, 40, 52, 9)) for seed in range(3)]


@pytest.fixture(params=range(len(drawn())))
def planes(request):
    return drawn()[request.param]


@pytest.mark.parametrize("stage", STAGES)
def test_gradients(stage):
    generator = torch.Generator().manual_seed(3)
    layers = torch.rand(1, 8, *SIZE, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(STAGES[stage], layers.requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("kind", ["zeros", "ones", "uniform", "binary"])
def test_gradients_are_finite_at_the_edge(stage, kind):
    level = {"zeros": 0.0, "ones": 1.0, "uniform": 1 / 9, "binary": HALF}[kind]
    layers = (torch.ones(1, 8, *SIZE) * level).double().requires_grad_()
    found = STAGES[stage](layers)
    (found * torch.arange(found.numel()).view(found.shape).double().cos()).sum().backward()
    assert found.isfinite().all()
    assert layers.grad.isfinite().all()


# ---- layers


@pytest.mark.parametrize("channels", [12, 8])
def test_one_hot_labels_give_the_layers(channels):
    """With 8 channels cars and what follows have none: what is missing to 1 is void."""
    labels = street(0)
    some = one_hot(labels)[:, :channels]
    assert bool(some.sum(1).all()) == (channels == 12)
    soft = soft_layers(some, membership(label_space(SPACE), channels), 1.0)
    torch.testing.assert_close(soft, unpack(layers_of(labels)).double(), rtol=0, atol=2e-5)
    assert not are_probabilities(some * 0)


def test_logits_and_their_probabilities_give_the_same():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 12, 5, 4, generator=generator).double() * 3
    assert not are_probabilities(logits)
    for dtype in (torch.float64, torch.half, torch.bfloat16):
        assert are_probabilities(logits.softmax(1).to(dtype).float())
    for temperature, error in ((0.5, 1e-4), (1.0, 1e-4), (3.0, 0.02)):
        torch.testing.assert_close(
            soft_layers(logits.softmax(1), MEMBERS, temperature),
            soft_layers(logits, MEMBERS, temperature),
            rtol=0,
            atol=error,
        )


def test_a_layer_is_the_sum_of_its_classes():
    logits = torch.randn(1, 12, 3, 3).double()
    classes, soft = logits.softmax(1), soft_layers(logits, MEMBERS, 1.0)
    torch.testing.assert_close(soft[:, 3], classes[:, 2] + classes[:, 6])  # pole and sign
    torch.testing.assert_close(soft.sum(1), 1 - classes[:, 8:].sum(1))  # dynamic and void


def test_gradients_of_layers():
    logits = torch.randn(1, 12, 2, 3, dtype=torch.float64)
    for scores in (logits, logits.softmax(1)):
        for temperature in (0.5, 2.0):
            assert torch.autograd.gradcheck(
                lambda x, t=temperature: soft_layers(x, MEMBERS, t), scores.requires_grad_()
            )
        scores.detach_()


def test_mean_fractions_become_the_majority():
    labels = street(1, 27, 36)
    soft = unpack(layers_of(labels)).double()
    rows, columns = np.arange(27) // 3, np.arange(36) // 3
    plain = np.zeros((8, 9, 12))
    np.add.at(plain, (slice(None), rows[:, None], columns[None]), soft[0].numpy() / 9)
    np.testing.assert_allclose(soft_majority(soft, (9, 12), 1.0)[0], plain, atol=1e-5)
    table, origin = category_table(label_space(SPACE))
    voted = reduce_by_majority(categorise(torch.from_numpy(labels)[None], table, origin), (9, 12))
    counts = torch.from_numpy(np.concatenate([plain, 1 - plain.sum(0, keepdims=True)]))
    best = counts.topk(2, dim=0).values
    clear = best[0] - best[1] > 0.05
    found = soft_majority(soft, (9, 12), 0.01)[0]
    assert clear.float().mean() > 0.8
    whole = torch.eye(NO_LAYER + 1)[voted[0].long()].permute(2, 0, 1)[:8]
    torch.testing.assert_close(found[:, clear].float(), whole[:, clear], rtol=0, atol=0.01)


# ---- morphology, regions, skeleton


def test_morphology_of_zeros_and_ones(planes):
    for opening, closing in ((0, 0), (1, 0), (0, 2), (1, 3)):
        soft = soft_open_and_close(unpack(planes).float(), opening, closing)
        assert torch.equal(soft.bool(), unpack(open_and_close(planes, opening, closing)))
        assert torch.equal(soft, soft.round())


def test_morphology_is_that_of_kornia():
    morphology = pytest.importorskip("kornia.morphology", reason="kornia is not installed")
    layers, square = torch.rand(2, 3, 11, 14), torch.ones(5, 5)
    torch.testing.assert_close(soft_dilate(layers, 2), morphology.dilation(layers, square))
    torch.testing.assert_close(soft_erode(layers, 2), morphology.erosion(layers, square))
    both = morphology.closing(morphology.opening(layers, square), square)
    torch.testing.assert_close(soft_open_and_close(layers, 2, 2), both)


def test_holes_and_regions_of_zeros_and_ones(planes):
    cleaned = drop_regions(fill_holes(planes, 6), 5)
    before, after = unpack(planes), unpack(cleaned)
    assert torch.equal(soft_regions(before.float(), before, after), after.float())
    layers, kept = torch.rand(before.shape), before == after
    assert torch.equal(soft_regions(layers, before, after)[kept], layers[kept])


def test_the_thinned_skeleton_without_softness(planes):
    layers, thinned = unpack(planes).float(), unpack(thin(planes, zhang_suen))
    assert torch.equal(soft_skeleton(layers, thinned, 0.0), thinned.float())
    assert torch.equal(soft_skeleton(layers, thinned, 1.0), eroded_skeleton(layers))


def plain_skeleton(layer: np.ndarray) -> np.ndarray:
    """Algorithm 1 of Shit et al. with a square of 3 x 3, half the longer side deep."""
    skeleton = np.zeros_like(layer)
    for depth in range(max(layer.shape) // 2 + 1):
        eroded = ndimage.grey_erosion(layer, (3, 3), mode="constant", cval=np.inf)
        opened = ndimage.grey_dilation(eroded, (3, 3), mode="constant", cval=-np.inf)
        found = np.maximum(layer - opened, 0)
        skeleton = skeleton + np.maximum(found - skeleton * found, 0) if depth else found
        layer = eroded
    return skeleton


def test_the_eroded_skeleton_is_that_of_the_paper():
    layers = torch.rand(1, 2, 19, 26).double()
    layers[0, 1] = torch.from_numpy(ndimage.gaussian_filter(layers[0, 0].numpy(), 2))
    for layer, found in zip(layers[0], eroded_skeleton(layers)[0], strict=True):
        np.testing.assert_allclose(found, plain_skeleton(layer.numpy()), atol=1e-12)


def test_a_large_skeleton_keeps_its_length():
    layers = torch.zeros(1, 8, 3 * COARSE, 4 * COARSE)
    layers[0, 0, 90:99, 30:-30] = 1.0
    length = float(eroded_skeleton(layers).sum())
    assert 0.8 < length / (layers.shape[3] - 60) < 1.2


# ---- keypoints, centroid, shape context, aggregation


def test_key_points_of_skeletons(planes):
    skeleton = thin(planes, zhang_suen)
    soft = unpack(skeleton).float()
    assert torch.equal(soft_end_points(soft), unpack(end_points(skeleton)).float())
    assert torch.equal(soft_intersections(soft), unpack(intersections(skeleton)).float())
    both = unpack(end_points(skeleton) | intersections(skeleton)).float()
    assert torch.equal(soft_keypoints(soft), both)


def test_centres_are_those_of_the_layers(planes):
    layers = unpack(planes)
    soft, hard = soft_centroids(layers.double()), centre_table(centroids(planes), 1)
    there = layers.any((2, 3))
    assert ((soft - hard).abs().amax(-1)[there] <= 0.5 + 1e-3).all()
    middle = (torch.tensor(layers.shape[2:]) - 1) / 2
    assert torch.equal(soft[~there], middle.double().expand(int((~there).sum()), 2))


def test_the_map_of_a_centre_has_it_as_its_mean():
    centres = torch.tensor([[[2.25, 3.5], [0.0, 6.0]]]).double()
    maps = soft_points(centres, *SIZE)
    torch.testing.assert_close(maps.sum((2, 3)), torch.ones(1, 2).double())
    torch.testing.assert_close(soft_centroids(maps), centres, rtol=0, atol=4e-3)
    assert int((maps[0, 0] > 0).sum()) == 4


@pytest.mark.parametrize("sectors", [1, 5, 12])
def test_shape_contexts_of_points(planes, sectors):
    height, width = planes.shape[1:]
    config = SSRVLADConfig.from_preset("paper", sectors=sectors)
    limits = config.ring_limits(height, width)
    skeleton = thin(planes, zhang_suen)
    ends = end_points(skeleton)
    bins = log_polar_bins(height, width, limits, sectors, CPU)
    hard = shape_contexts(points(ends), points(skeleton), bins, 1)
    smooth = bin_masks(height, width, limits, sectors, 0.0, torch.float64, CPU)
    soft = soft_shape_contexts(unpack(ends).double(), unpack(skeleton).double(), smooth)
    torch.testing.assert_close(soft, hard.double(), rtol=0, atol=1e-8)


@pytest.mark.parametrize("sectors", [1, 4, 7])
def test_smooth_masks_lose_nothing(sectors):
    whole, smooth = (masks(softness, (20, 30), sectors) for softness in (0.0, 0.7))
    within = whole.sum(0) > 0
    assert not within[0, 0]
    torch.testing.assert_close(smooth.sum(0)[within], whole.sum(0)[within])
    assert (smooth.sum(0) <= 1 + 1e-9).all()
    assert ((smooth > 0).sum(0) > 1).any()


def test_smooth_masks_by_hand():
    """Limits 4 and 16: rings end at distances 2 and 4; the ramp of half a ring ends at 2 ** 1.5."""
    smooth = masks(0.5, (20, 30)).view(2, 4, 40, 60)
    assert smooth[:, 0, 0, 2].tolist() == [1.0, 0.0]  # on the boundary, in the ring inside
    assert smooth[:, 0, 0, 3].tolist() == [0.0, 1.0]
    ramp = smooth[:, 1, 2, -1]  # two down and one left: distance 5 ** 0.5, angle 116.6 degrees
    past = (np.log2(5) / 2 - 1) / 0.5
    np.testing.assert_allclose(ramp, [1 - past, past], atol=1e-12)
    np.testing.assert_allclose(smooth[1, :2, 4, 0], [0.0, 1.0])  # straight down starts sector 1
    angle = np.degrees(np.arctan2(3, 1))
    into = (angle / 90 - 0.5) / 0.5
    np.testing.assert_allclose(smooth[1, :2, 3, 1], [1 - into, into], atol=1e-9)


def test_aggregation_of_counts(planes):
    skeleton = thin(planes, zhang_suen)
    keypoints = end_points(skeleton) | intersections(skeleton)
    limits = SSRVLADConfig.from_preset("paper").ring_limits(*planes.shape[1:])
    table = log_polar_bins(*planes.shape[1:], limits, 12, CPU)
    listed = points(keypoints)
    sums = shape_contexts(listed, points(skeleton), table, 1)
    centres = shape_contexts(centroids(planes), points(skeleton), table, 1)
    counts = count_points(listed, 1)
    hard = aggregate(sums, centres, counts)
    residuals = (sums - counts[..., None] * centres).double()
    soft = soft_aggregate(1e4 * residuals)
    torch.testing.assert_close(soft.float(), hard, rtol=0, atol=1e-4)


def test_a_faint_layer_does_not_weigh_as_a_clear_one():
    residuals = torch.zeros(1, 8, 60)
    residuals[0, 0, 3], residuals[0, 1, 4] = 500.0, 0.01
    found = soft_aggregate(residuals).view(8, 60)
    assert found[0, 3] > 0.99
    assert found[1, 4] < 0.02


# ---- around the vanishing column


def test_vanishing_columns_of_layers():
    planes = torch.cat([layers_of(blobs(seed, 40, 60, 14)) for seed in range(8)])
    soft, hard = soft_vanishing_columns(unpack(planes).double()), vanishing_columns(planes)
    assert hard.any()
    assert ((soft - hard).abs() <= 1.0).all()


def test_pooling_by_any_shift(planes):
    layers = unpack(planes).double()
    for shift in (0, 3, -7):
        moved = torch.tensor([shift])
        hard = pool(planes, moved)
        soft = soft_pool(layers, moved.double(), tuple(hard.shape[2:]))
        torch.testing.assert_close(soft, hard)
    layers = torch.rand(1, 8, 12, 16).double()
    one, between, two = (soft_pool(layers, layers.new_tensor([x]), CELLS) for x in (1, 1.25, 2))
    torch.testing.assert_close(between, 0.75 * one + 0.25 * two)


@pytest.mark.parametrize("size", [(2, 9), (3, 3), (17, 23)])
def test_boundaries_of_layers(size):
    planes = merge(torch.cat([layers_of(blobs(seed, *size, 5)) for seed in range(3)]))
    hard = unpack(boundaries(planes))[:, :4].double()
    assert torch.equal(soft_boundaries(unpack(planes)[:, :6].double()), hard)


def test_rare_layers_are_merged():
    planes = split(torch.randint(0, 9, (2, 7, 5), dtype=torch.uint8))
    merged = soft_merge(unpack(planes).double())
    assert torch.equal(merged, unpack(merge(planes))[:, :6].double())


def test_coefficients_of_layers():
    planes = torch.cat([layers_of(blobs(seed, 48, 64, 12)) for seed in range(3)])
    still = torch.zeros(3, dtype=torch.int64)
    area, lengths = pool(planes, still)[:, :6], pool(boundaries(planes), still)[:, :4]
    bins, basis = bin_table((24, 32), 6, 20, 0.5, 1 / 6), basis_table(6, 20, 60, 1.0)
    hard = coefficients(soft_histograms(torch.cat((area, lengths), 1), bins), basis, (60, 20), 0.75)
    soft = soft_coefficients(area, lengths, bins, basis, (60, 20), 0.75).float()
    assert ((hard * soft).sum(1) > 0.99).all()


def test_the_root_is_safe_at_zero():
    fractions = torch.linspace(0, 1, 11).double().requires_grad_()
    roots = safe_root(fractions)
    roots.sum().backward()
    assert roots[0] == 0
    assert (fractions.grad <= 20).all()
    assert ((roots - fractions.sqrt()).abs() <= 0.04).all()
