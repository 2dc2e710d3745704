"""Standardise: what is subtracted from which traverse."""

import pytest
import torch
import torch.nn.functional as F

from ssrvlad_torch.recognition.standardise import sharing, standardise


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


def test_refuses():
    with pytest.raises(ValueError, match="each of 3 frames, got 1"):
        standardise(torch.zeros(3, 4), ["a"])
    with pytest.raises(ValueError, match="row 2 of the descriptors holds values that are not"):
        standardise(torch.tensor([[1.0], [0.0], [torch.nan]]))
