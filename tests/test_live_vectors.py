"""Vectors of a live stream: their scores against the steps of `recognition`, and their blocks."""

import numpy as np
import pytest
import torch
from hypothesis import given
from loop_streams import noisy_stream, streams

from ssrvlad_torch.channels.live_vectors import BEFORE, LiveVectors
from ssrvlad_torch.recognition.sweep import score


def fed(vectors):
    memory = LiveVectors(480)
    for vector in vectors:
        memory.add(vector)
    return memory


@given(streams)
def test_scores_are_those_of_standardised_descriptors(stream):
    swept, _ = stream
    swept = swept[swept[:, 0].any(axis=1)]
    centre = swept.shape[1] // 2
    if len(swept) < 3:
        return
    mean = torch.from_numpy(swept[:, centre]).double().mean(0)
    known = torch.from_numpy(swept[:-1, centre]) - mean
    query = torch.from_numpy(swept[-1:]) - mean
    if min(known.norm(dim=1).min(), query.norm(dim=2).min()) < 0.05:
        return  # the directions of such differences are mostly rounding
    expected = score(query.float(), known.float())[0]
    got = fed(swept[:-1, centre]).scores(swept[-1])
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-4)


def test_each_sequence_has_its_own_mean():
    vectors = noisy_stream(3, 90, 80, [])[0][:, 0]
    vectors = vectors[vectors.any(axis=1)]
    memory, ends = LiveVectors(480), (40, 55, len(vectors) - 1)
    for number, vector in enumerate(vectors[:-1]):
        if number in ends:
            memory.start_sequence()
        memory.add(vector)
    parts, centred = np.split(vectors.astype(np.float64), ends[:-1]), []
    for number, part in enumerate(parts):
        before = np.concatenate([np.empty((0, 480)), *parts[:number]])
        extra = [before.mean(0)] * BEFORE if number else []
        centred.append(part - np.concatenate((part, np.reshape(extra, (-1, 480)))).mean(0))
    plain = np.concatenate(centred)
    plain /= np.linalg.norm(plain, axis=1, keepdims=True)
    np.testing.assert_allclose(memory.scores(vectors[-1:]), plain[:-1] @ plain[-1], atol=1e-5)


def test_blocks_do_not_show(monkeypatch):
    vectors = noisy_stream(1, 26, 12, [])[0][:, 0]
    whole = fed(vectors[:25])
    monkeypatch.setattr("ssrvlad_torch.channels.live_vectors.BLOCK_ROWS", 4)
    parts = fed(vectors[:25])
    np.testing.assert_array_equal(parts.descriptors(3, 22), vectors[3:22])
    np.testing.assert_array_equal(whole.descriptors(3, 22), vectors[3:22])
    assert parts.descriptors(25, 25).shape == (0, 480)
    np.testing.assert_allclose(parts.scores(vectors[25:]), whole.scores(vectors[25:]), atol=1e-6)


def test_frames_that_are_all_alike_have_equal_scores():
    vectors = np.repeat(np.eye(480, dtype=np.float32)[:1], 9, axis=0)
    assert fed(vectors[:8]).scores(vectors[8:]).tolist() == [0] * 8


@pytest.mark.parametrize("anchors", [1, 3])
def test_an_empty_frame_has_no_score(anchors):
    swept = noisy_stream(2, 30, 20, [], anchors)[0]
    swept[[4, 9]] = 0
    memory = fed(swept[:-1, anchors // 2])
    np.testing.assert_array_equal(np.isinf(memory.scores(swept[-1])), memory.empty)
    assert memory.empty[[4, 9]].all()
