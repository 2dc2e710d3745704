"""Shifted skeletons: unshifted they are the head's, shifted they are what the reference counts."""

import numpy as np
import pytest
import torch
from _skeleton_noise import SkeletonPoints
from drawings import SPACE
from helpers import street

from ssrvlad_torch import SSRVLAD, reference

SIZE = (60, 84)


def head(preset, **settings):
    return SSRVLAD.from_preset(preset, labels_as=SPACE, **settings)


def streets(count, size=SIZE):
    return torch.stack([torch.from_numpy(street(seed, *size)) for seed in range(count)])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def by_layer(points, images):
    """``(n, 2)`` rows and columns of the points of each layer of each image."""
    yx = torch.stack((points.y, points.x), 1).numpy()
    group = points.group.numpy()
    return [[yx[group == k * images + b] for k in range(8)] for b in range(images)]


@pytest.mark.parametrize("settings", [{}, {"working_size": 40}, {"context": "keypoints"}])
def test_points_that_were_not_shifted_are_described_as_the_head_does(settings):
    module, labels = head("paper", **settings), streets(3)
    points = SkeletonPoints.of(module, labels)
    wanted = module(labels)
    torch.testing.assert_close(points.descriptors(), wanted, rtol=0, atol=1e-6)
    for nodes_only in (False, True):
        still = points.shifted(0, generator(), nodes_only)
        torch.testing.assert_close(still.descriptors(), wanted, rtol=0, atol=1e-6)


def test_every_shift_is_drawn_alone_and_all_are_equally_likely():
    points = SkeletonPoints.of(head("paper"), streets(8))
    moved = points.shifted(3, generator())
    dy, dx = moved.skeleton.y - points.skeleton.y, moved.skeleton.x - points.skeleton.x
    assert torch.equal(moved.skeleton.group, points.skeleton.group)
    counts = torch.bincount(7 * (dy + 3) + dx + 3, minlength=49).double()
    assert len(counts) == 49
    expected = len(dy) / 49
    chi_squared = float(((counts - expected) ** 2 / expected).sum())
    assert chi_squared < 84  # 0.999 of 48 degrees of freedom


def test_a_key_point_goes_with_its_skeleton_pixel():
    points = SkeletonPoints.of(head("paper"), streets(2))
    moved = points.shifted(5, generator())
    rows = points.node_rows
    for before, after, part in zip(points.nodes, moved.nodes, moved.skeleton, strict=True):
        assert len(before) == len(after)
        assert torch.equal(after, part[rows])


def test_nodes_alone_leave_the_skeleton():
    points = SkeletonPoints.of(head("paper"), streets(2))
    moved = points.shifted(5, generator(), nodes_only=True)
    assert moved.skeleton is points.skeleton
    assert not torch.equal(moved.nodes.y, points.nodes.y)
    assert torch.equal(moved.nodes.y, points.shifted(5, generator()).nodes.y)


def test_shifts_shrink_with_the_grid():
    points = SkeletonPoints.of(head("paper", working_size=20), streets(4))
    moved = points.shifted(9, generator())
    shift = moved.skeleton.y - points.skeleton.y
    assert (int(shift.min()), int(shift.max())) == (-3, 3)


@pytest.mark.parametrize("nodes_only", [False, True])
@pytest.mark.parametrize("context", ["skeleton", "keypoints"])
def test_the_paper_counts_as_the_reference_does(nodes_only, context):
    module, labels = head("paper", context=context), streets(2)
    config = module.config
    moved = SkeletonPoints.of(module, labels).shifted(30, generator(), nodes_only)
    listed = [by_layer(part, 2) for part in (moved.skeleton, moved.nodes, moved.centres)]
    assert min(int(moved.nodes.y.min()), int(moved.nodes.x.min())) < 0  # some are outside
    for image, got in enumerate(moved.descriptors()):
        vectors = []
        for skeleton, nodes, centre in zip(*(part[image] for part in listed), strict=True):
            seen = skeleton if context == "skeleton" else nodes
            rules = (config.ring_limits(*SIZE), config.sectors)
            residual = np.zeros((config.rings, config.sectors))
            for point in nodes:
                residual += reference.shape_context(point, seen, *rules)
                residual -= reference.shape_context(centre[0], seen, *rules)
            vectors.append(reference.normalise(residual.ravel()))
        wanted = reference.normalise(np.concatenate(vectors))
        np.testing.assert_allclose(got.numpy(), wanted, atol=1e-6)
