"""The oracle of a live stream: its scores by plain matrices, and how a street repeats."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from loop_streams import noisy_stream, streams
from test_signs import SHAPE, drive

from ssrvlad_torch.channels.signs import numbers
from ssrvlad_torch.loops.reference import (
    BEFORE,
    TRACK,
    Repeats,
    scores_of_signs,
    scores_of_vectors,
)
from ssrvlad_torch.recognition.reference import MOVES
from ssrvlad_torch.recognition.sweep import score


def without_means(frames, ends):
    """Frames ``(N, ...)`` without the means of their stretches; the mean of all before counts in
    each as some frames."""
    centred = []
    for first, last in zip([0, *ends], [*ends, len(frames)], strict=True):
        part, before = frames[first:last], frames[:first]
        extra = [before.mean(0)] * BEFORE if first else []
        centred += [*(part - np.mean([*part, *extra], axis=0))]
    return np.array(centred)


@given(streams)
def test_vectors_have_the_scores_of_standardised_descriptors(stream):
    swept, _ = stream
    swept = swept[swept[:, 0].any(axis=1)]
    centre = swept.shape[1] // 2
    if len(swept) < 3:
        return
    mean = torch.from_numpy(swept[:, centre]).double().mean(0)
    known, query = (torch.from_numpy(each) - mean for each in (swept[:-1, centre], swept[-1:]))
    if min(known.norm(dim=1).min(), query.norm(dim=2).min()) < 0.05:
        return  # the directions of such differences are mostly rounding
    got = scores_of_vectors(swept[:-1, centre], swept[-1], [0])
    np.testing.assert_allclose(got, score(query, known)[0], rtol=0, atol=1e-5)


def test_each_stretch_of_vectors_has_its_own_mean():
    vectors = noisy_stream(3, 90, 80, [])[0][:, 0]
    vectors = vectors[vectors.any(axis=1)]
    plain = without_means(vectors.astype(np.float64), (40, 55))
    plain /= np.linalg.norm(plain, axis=1, keepdims=True)
    got = scores_of_vectors(vectors[:-1], vectors[-1:], [0, 40, 55])
    np.testing.assert_allclose(got, plain[:-1] @ plain[-1], atol=1e-9)


@pytest.mark.parametrize("ends", [(), (25, 40)])
def test_signs_have_the_scores_of_numbers_without_the_means(ends):
    signs = drive(60).numpy()
    every = numbers(torch.from_numpy(signs)).double().flatten(2).numpy()
    centred, scores = torch.from_numpy(without_means(every, ends)), []
    for move in range(-MOVES, MOVES + 1):
        kept = [c for c in range(SHAPE[0]) if 0 <= c - move < SHAPE[0]]
        here, there = centred[-1, [c - move for c in kept]], centred[:-1, kept]
        scores.append(F.normalize(there.flatten(1), dim=1) @ F.normalize(here.flatten(), dim=0))
    got = scores_of_signs(signs[:-1], signs[-1], [0, *ends])
    np.testing.assert_allclose(got, torch.stack(scores).amax(0), atol=1e-9)


def test_frames_that_are_all_alike_have_equal_scores():
    vectors = np.repeat(np.eye(480, dtype=np.float32)[:1], 9, axis=0)
    assert scores_of_vectors(vectors[:8], vectors[8:], [0]).tolist() == [0] * 8
    signs = np.repeat(drive(1).numpy(), 4, axis=0)
    assert abs(scores_of_signs(signs[:3], signs[3], [0])).max() <= 1


@pytest.mark.parametrize("anchors", [1, 3])
def test_an_empty_frame_has_no_score(anchors):
    swept = noisy_stream(2, 30, 20, [], anchors)[0]
    swept[[4, 9]] = 0
    known = swept[:-1, anchors // 2]
    got = np.isinf(scores_of_vectors(known, swept[-1], [0]))
    np.testing.assert_array_equal(got, ~known.any(axis=1))


def repeats_of(places, exclude=20):
    """The nearness of the frames of a drive to others of its street: 1 where places are equal."""
    repeats, places = Repeats(exclude), np.array(places)
    for number in range(len(places)):
        repeats.after((places[:number] == places[number]).astype(float))
    return repeats.highest[:-1]


def test_frames_of_a_street_that_repeats_are_known():
    """Every seventh frame shows the same; the street of the first frames does not repeat."""
    found = repeats_of([*range(100, 140), *(n % 7 for n in range(60)), *range(200, 240)])
    assert (found[45:95] == 1).all()
    assert (found[:20] == 0).all() and (found[-20:] == 0).all()


def test_single_frames_that_are_alike_are_no_repeat():
    places = [*range(100)]
    places[50] = places[42]
    assert repeats_of(places).max() == pytest.approx(1 / TRACK)


def test_loops_farther_back_than_the_excluded_frames_are_no_repeats():
    assert repeats_of([*range(60), *range(60)]).max() == 0
    assert np.isneginf(repeats_of([1] * 50, exclude=0)).all()
