"""Signs of a live stream, against the mean of all frames so far as numbers."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from test_signs import SHAPE, drive

from ssrvlad_torch.channels.live_signs import LiveSigns
from ssrvlad_torch.channels.live_vectors import BEFORE
from ssrvlad_torch.channels.signs import REACH, moved, numbers


def of_centred(centred):
    """The scores of the last of some frames."""
    rows, query = centred[:-1], centred[-1:]
    scores = []
    for move in range(-REACH, REACH + 1):
        kept = [c for c in range(SHAPE[0]) if 0 <= c - move < SHAPE[0]]
        here, there = (each[:, kept].flatten(1) for each in (moved(query, move), rows))
        scores.append(F.normalize(there, dim=1) @ F.normalize(here, dim=1)[0])
    return torch.stack(scores).amax(0).float()


def test_scores_are_those_of_numbers_without_the_mean_so_far():
    frames, memory = drive(50).numpy(), LiveSigns(SHAPE)
    every = numbers(torch.from_numpy(frames)).double()
    memory.add(frames[0])
    for row in range(1, 50):
        got = torch.from_numpy(memory.scores(frames[row : row + 1]))
        so_far = every[: row + 1]
        expected = of_centred(so_far - so_far.mean(0))
        torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)
        memory.add(frames[row])
    assert len(memory) == 50
    np.testing.assert_array_equal(memory.descriptors(3, 9), frames[3:9])


def test_each_sequence_has_its_own_mean():
    """A row and a new frame without the means of their sequences, by matrices of numbers."""
    frames, memory = drive(60), LiveSigns(SHAPE)
    for number, frame in enumerate(frames[:-1].numpy()):
        if number in (25, 40):
            memory.start_sequence()
        memory.add(frame)
    parts, centred = [*numbers(frames).double().split([25, 15, 20])], []
    for number, part in enumerate(parts):
        extra = [torch.cat(parts[:number]).mean(0)] * BEFORE if number else []
        centred.append(part - torch.stack([*part, *extra]).mean(0))
    got = torch.from_numpy(memory.scores(frames[-1:].numpy()))
    torch.testing.assert_close(got, of_centred(torch.cat(centred)), atol=1e-5, rtol=0)


def test_frames_that_are_loaded_count_as_if_they_had_come():
    frames, one, both = drive(40).numpy(), LiveSigns(SHAPE), LiveSigns(SHAPE)
    for frame in frames[:12]:
        one.add(frame)
    both.extend(torch.from_numpy(frames[:12]))
    for memory in (one, both):
        memory.start_sequence()
    for frame in frames[12:30]:
        one.add(frame)
    both.extend(torch.from_numpy(frames[12:30]))
    for frame in frames[30:]:
        np.testing.assert_allclose(one.scores(frame[None]), both.scores(frame[None]), 1e-5, 1e-6)
        one.add(frame)
        both.add(frame)


def test_equal_frames_have_finite_scores():
    frame, memory = drive(1)[0].numpy(), LiveSigns(SHAPE)
    for _ in range(3):
        memory.add(frame)
    assert abs(memory.scores(frame[None])).max() <= 1


@pytest.mark.parametrize("wrong", [torch.zeros(SHAPE), torch.zeros(SHAPE[1:], dtype=torch.uint8)])
def test_other_signs_are_refused(wrong):
    with pytest.raises(ValueError, match=r"frame 'a': expected signs \(8, 3, 4\) uint8, got"):
        LiveSigns(SHAPE).checked(wrong, "a")
