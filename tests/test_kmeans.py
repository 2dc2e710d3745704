"""k-means: well-parted groups are found, a step lowers the cost, seeds repeat."""

from __future__ import annotations

import pytest
import torch

from ssrvlad_torch.baselines import kmeans as module
from ssrvlad_torch.baselines.kmeans import kmeans, nearest_centres


def groups(count: int, each: int, width: int = 3) -> torch.Tensor:
    torch.manual_seed(0)
    centres = 100 * torch.rand(count, width)
    return (centres[:, None] + 0.01 * torch.randn(count, each, width)).flatten(0, 1)


def cost(points: torch.Tensor, centres: torch.Tensor) -> float:
    return float(torch.cdist(points.double(), centres.double()).min(dim=1).values.square().sum())


@pytest.mark.parametrize("seed", range(5))
def test_well_parted_groups_are_found(seed):
    points = groups(6, 20)
    centres = kmeans(points, 6, seed)
    wanted = points.reshape(6, 20, 3).mean(dim=1)
    found = centres[nearest_centres(wanted, centres)]
    torch.testing.assert_close(found, wanted)


def test_the_centres_are_the_means_of_their_points():
    points = torch.rand(500, 4, generator=torch.Generator().manual_seed(1))
    centres = kmeans(points, 7)
    nearest = nearest_centres(points, centres)
    means = torch.stack([points[nearest == k].mean(dim=0) for k in range(7)])
    torch.testing.assert_close(centres, means)


def test_rounds_lower_the_cost():
    points = torch.rand(400, 4, generator=torch.Generator().manual_seed(2))
    costs = [cost(points, kmeans(points, 8, rounds=rounds)) for rounds in (0, 1, 3, 100)]
    assert costs == sorted(costs, reverse=True)
    assert costs[0] > costs[-1]


def test_blocks_do_not_show(monkeypatch):
    points = torch.rand(100, 4, generator=torch.Generator().manual_seed(3))
    whole = kmeans(points, 5)
    monkeypatch.setattr(module, "_BLOCK", 7)
    torch.testing.assert_close(kmeans(points, 5), whole)


def test_the_same_seed_gives_the_same():
    points = torch.rand(100, 4, generator=torch.Generator().manual_seed(3))
    assert torch.equal(kmeans(points, 5, seed=1), kmeans(points, 5, seed=1))
    assert not torch.equal(kmeans(points, 5, seed=1), kmeans(points, 5, seed=2))


def test_nearest_centres_are_those_of_euclid():
    torch.manual_seed(0)
    points, centres = torch.randn(50, 6), torch.randn(9, 6)
    assert torch.equal(nearest_centres(points, centres), torch.cdist(points, centres).argmin(1))


@pytest.mark.parametrize("points", [torch.ones(10, 2), torch.rand(1, 2), torch.empty(0, 2)])
def test_too_few_distinct_points(points):
    with pytest.raises(ValueError, match="2 centres need as many distinct points, got"):
        kmeans(points, 2)


def test_as_many_centres_as_points():
    points = torch.tensor([[1.0], [2], [4]])
    assert sorted(kmeans(points, 3)[:, 0].tolist()) == [1, 2, 4]
