"""`recognition.standardise` and `recognition.sweep`."""

import pytest
import torch
import torch.nn.functional as F

from ssrvlad_torch.recognition.standardise import standardise
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


def test_the_mean_so_far_ends_as_the_mean_of_all():
    frames = traverse(50, 3, 2.0)
    running = standardise(frames, running=True)
    assert torch.equal(running[0], frames[0])
    torch.testing.assert_close(running[-1], standardise(frames)[-1])
    torch.testing.assert_close(running[:20], standardise(frames[:20], running=True))


def test_empty_frames_stay_empty_and_count_in_no_mean():
    frames = traverse(20, 3, 2.0)
    holed = torch.cat((frames[:10], torch.zeros(3, 32), frames[10:]))
    after = standardise(holed)
    assert not after[10:13].any()
    torch.testing.assert_close(after[:10], standardise(frames)[:10])


def test_a_frame_alone_keeps_its_descriptor():
    frame = traverse(1, 1, 1.0)
    assert torch.equal(standardise(frame), frame)


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
