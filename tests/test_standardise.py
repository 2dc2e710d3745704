"""`recognition.standardise` and `recognition.sweep`."""

import pytest
import torch
import torch.nn.functional as F

from ssrvlad_torch.recognition.standardise import sharing, standardise
from ssrvlad_torch.recognition.sweep import narrowed, score


def traverse(rows: int, seed: int, common: float) -> torch.Tensor:
    """Descriptors of the same places, drowned in what each traverse has of its own."""
    places = torch.randn(rows, 32, generator=torch.Generator().manual_seed(0))
    shift = torch.randn(32, generator=torch.Generator().manual_seed(seed))
    return F.normalize(places + common * shift, dim=1)


def test_each_traverse_loses_its_own_mean():
    one, other = traverse(40, 1, 4.0), traverse(40, 2, 4.0)
    both = standardise(torch.cat((one, other)), ["a"] * 40 + ["b"] * 40)
    raw = (one @ other.T).argmax(1) == torch.arange(40)
    found = (both[:40] @ both[40:].T).argmax(1) == torch.arange(40)
    assert raw.float().mean() < 0.5 and found.all()
    assert torch.equal(both[:40], standardise(one))
    torch.testing.assert_close(both.norm(dim=1), torch.ones(80))


@pytest.mark.parametrize("frames", [2, 5, 29])
def test_folders_of_a_drive_have_its_mean(frames):
    drive, other = traverse(58, 1, 4.0), traverse(40, 2, 4.0)
    names = [f"a{row // frames}" for row in range(58)] + ["b"] * 40
    after = standardise(torch.cat((drive, other)), names)
    torch.testing.assert_close(after, torch.cat((standardise(drive), standardise(other))))


def test_a_few_frames_beside_a_drive_have_the_mean_of_all():
    frames = traverse(44, 1, 4.0)
    after = standardise(frames, ["a"] * 40 + ["b"] * 4)
    torch.testing.assert_close(after[40:], standardise(frames)[40:])
    assert sharing([40, 4]) == {(0,): (0,), (1,): (0, 1)}


def test_a_few_frames_alone_stay_as_they_are():
    frames = traverse(29, 1, 4.0)
    torch.testing.assert_close(standardise(frames), frames)
    assert not sharing([2, 27])


def test_empty_frames_stay_empty_and_count_in_no_mean():
    frames = traverse(40, 3, 2.0)
    holed = torch.cat((frames[:10], torch.zeros(3, 32), frames[10:]))
    after = standardise(holed)
    assert not after[10:13].any()
    torch.testing.assert_close(after[:10], standardise(frames)[:10])


def test_a_reference_scores_its_best_anchor():
    swept = F.normalize(torch.randn(5, 3, 8), dim=2)
    references = F.normalize(torch.randn(7, 8), dim=1)
    swept[4], references[6] = 0, 0
    expected = torch.einsum("qsd,rd->qsr", swept, references).amax(1)
    expected[4], expected[:, 6] = -torch.inf, -torch.inf
    torch.testing.assert_close(score(swept, references), expected)
    torch.testing.assert_close(
        score(swept[:, 1], references)[:4, :6], (swept[:4, 1] @ references[:6].T)
    )


@pytest.mark.parametrize(("true_anchor", "width"), [(2, 0), (4, 8)])
def test_the_sweep_is_as_wide_as_the_view_is_shifted(true_anchor, width):
    generator = torch.Generator().manual_seed(0)
    places = F.normalize(torch.randn(40, 64, generator=generator), dim=1)
    swept = torch.randn(40, 5, 64, generator=generator)
    swept[:, true_anchor] = places * 6 + 0.3 * torch.randn(40, 64, generator=generator)
    kept, reach = narrowed(F.normalize(swept, dim=2), standardise(places), (-8, -4, 0, 4, 8))
    assert reach == width and kept.shape[1] == 1 + width // 2
    assert (score(kept, standardise(places)).argmax(1) == torch.arange(40)).float().mean() > 0.9


def test_refuses():
    with pytest.raises(ValueError, match=r"got \(3, 2, 4\) and \(5, 3\)"):
        score(torch.zeros(3, 2, 4), torch.zeros(5, 3))
    with pytest.raises(ValueError, match="each of 3 frames, got 1"):
        standardise(torch.zeros(3, 4), ["a"])
    with pytest.raises(ValueError, match="one of which is 0"):
        narrowed(torch.zeros(3, 2, 4), torch.zeros(5, 4), (-4, 4))
