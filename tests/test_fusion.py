import pytest
import torch

from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.recognition.fusion import FusedScores, moments, nearness

TRUST = {channel.name: channel.trust for channel in (LabelShapes, HOG, Features)}


def noisy(seed: int, noise: float, queries: int = 40, references: int = 60) -> torch.Tensor:
    """Scores of a method: the true match of query i is row i."""
    generator = torch.Generator().manual_seed(seed)
    shape = (queries, references)
    return 0.5 + 0.2 * torch.eye(*shape) + noise * torch.randn(shape, generator=generator)


def fuse(*members: torch.Tensor) -> FusedScores:
    """Fused by methods that are trusted alike."""
    return FusedScores({str(number): scores for number, scores in enumerate(members)})


def recall(scores: torch.Tensor) -> float:
    return float((scores.argmax(1) == torch.arange(len(scores))).float().mean())


def test_two_methods_that_err_apart_are_better_together():
    one, other = noisy(0, 0.08), noisy(1, 0.08)
    fused = fuse(one, other)
    assert recall(fused.whole()) > max(recall(one), recall(other)) + 0.1
    assert sum(fused.weights.values()) == pytest.approx(1)


def test_a_method_without_information_hardly_weighs():
    good, bad = noisy(0, 0.03), noisy(1, 10.0).clamp(max=0.99)
    fused = fuse(good, bad)
    assert fused.weights["0"] > 3 * fused.weights["1"]
    assert recall(fused.whole()) == recall(good) == 1


def test_one_method_alone_keeps_its_scores():
    scores = noisy(2, 0.05)
    fused = fuse(scores)
    torch.testing.assert_close(fused.whole(), scores)
    assert fused.weights == {"0": 1.0}


def test_the_unit_of_scores_does_not_matter():
    one, other = noisy(3, 0.05), noisy(4, 0.05)
    stretched = 1 - torch.exp(-(3 * nearness(other) - 1))
    assert fuse(one, stretched).weights == pytest.approx(fuse(one, other).weights)
    ranks = fuse(one, stretched).whole().argmax(1)
    assert torch.equal(ranks, fuse(one, other).whole().argmax(1))


def test_a_frame_that_one_method_cannot_describe_is_left_to_the_other():
    one, other = noisy(5, 0.02), noisy(6, 0.02)
    one[3], one[:, 7], other[:, 8] = -torch.inf, -torch.inf, -torch.inf
    one[:, 9] = other[:, 9] = -torch.inf
    found = fuse(one, other).whole()
    assert found[3].argmax() == 3
    assert found[7].argmax() == 7
    assert (found[:, 9] == -torch.inf).all()
    assert found.isfinite().sum() == found.numel() - len(found) - 1  # row 3, column 8


@pytest.mark.parametrize("shape", [(4, 5), (5, 0), (3, 11), (29, 40)])
def test_few_frames_weigh_alike(shape):
    fused = fuse(torch.rand(shape), torch.rand(shape))
    assert fused.whole().shape == shape
    assert fused.weights == {"0": 0.5, "1": 0.5}


def test_trust_decides_until_frames_show_which_method_leads():
    alike = noisy(7, 0.05)
    few = FusedScores(dict.fromkeys(TRUST, torch.rand(3, 20)), TRUST)
    assert few.weights == pytest.approx({"ssr-vlad": 1 / 9, "hog": 2 / 9, "features": 6 / 9})
    assert FusedScores(dict.fromkeys(TRUST, alike), TRUST).weights == pytest.approx(few.weights)
    both = {"features": noisy(8, 10.0).clamp(max=0.99), "hog": noisy(9, 0.01)}
    blind = FusedScores(both, TRUST)
    assert blind.weights["hog"] > 3 * blind.weights["features"]


def test_equal_scores_stay_finite_and_equal():
    fused = fuse(torch.full((3, 20), 0.25), torch.full((3, 20), 0.75))
    assert fused.whole().isfinite().all()
    assert (fused.whole() == fused.whole()[:, :1]).all()


@pytest.mark.parametrize(
    "scores", [[], [torch.rand(3)], [torch.rand(0, 4)], [torch.rand(3, 4), torch.rand(3, 5)]]
)
def test_shapes_that_do_not_fit_are_refused(scores):
    with pytest.raises(ValueError, match=r"expected scores \(Q, R\) of one shape, got"):
        fuse(*scores)


def test_moments_leave_out_what_has_no_score():
    scores = torch.rand(5000, generator=torch.Generator().manual_seed(0))
    near = nearness(scores).double()
    scores = torch.cat((scores, torch.full((9,), -torch.inf)))
    expected = float(near.mean()), float(near.std(correction=0))
    assert moments(scores) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("scores", [[], [0.3], [1.0] * 999, [-torch.inf] * 3, [0.1] * 5])
def test_scores_that_are_all_equal_have_no_spread(scores):
    assert moments(torch.tensor(scores))[1] <= 1e-6
