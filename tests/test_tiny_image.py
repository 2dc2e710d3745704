"""Tiny images against loops over patches and sequences."""

import numpy as np
import torch
from methods import frames, noise, picture

from ssrvlad_torch.baselines import make, tiny_image
from ssrvlad_torch.baselines.tiny_image import enhance


def image(seed):
    return picture(seed, 64, 128, grain=8)


def plain_picture(gray, height, width):
    """Area means, then patch by patch; the sides of ``gray`` are multiples of the small ones."""
    tall, wide = gray.shape[0] // height, gray.shape[1] // width
    tiny = gray.reshape(height, tall, width, wide).astype(float).mean((1, 3))
    for y in range(0, height, 8):
        for x in range(0, width, 8):
            patch = tiny[y : y + 8, x : x + 8]
            deviation = patch.std()
            patch -= patch.mean()
            patch /= deviation or 1
    return tiny


def plain_scores(difference, sequences):
    """Reference by reference."""
    scores = np.zeros_like(difference)
    for q, i in np.ndindex(difference.shape):
        around = [
            difference[q, j] for j in range(difference.shape[1]) if sequences[j] == sequences[i]
        ]
        deviation = np.std(around)
        z = (np.mean(around) - difference[q, i]) / deviation if deviation > 1e-9 else 0
        scores[q, i] = 1 - np.exp(-z)
    return scores


def test_scores_equal_loops_whatever_the_block(monkeypatch):
    monkeypatch.setattr(tiny_image, "_SCORES_AT_ONCE", 18)
    method = make("tiny-image")
    drives = [*frames(map(image, range(6)), "a"), *frames(map(image, range(6, 9)), "b")]
    queries = [image(seed) for seed in (1, 4, 8, 20, 21)]
    result = method.scores(method.encode_query(frames(queries)), method.encode_reference(drives))
    assert (result.shape, result.dtype) == ((5, 9), torch.float32)
    alone = method.encode_reference([*frames([image(0)], "a"), *frames([image(1)] * 50, "b")])
    assert not method.scores(method.encode_query(frames(queries)), alone).any(), "all are alike"
    there = np.stack([plain_picture(frame.picture[..., 0], 32, 64) for frame in drives])
    here = np.stack([plain_picture(query[..., 0], 32, 64) for query in queries])
    difference = np.abs(here[:, None] - there).mean((2, 3))
    expected = plain_scores(difference, [frame.sequence for frame in drives])
    np.testing.assert_allclose(result.numpy(), expected, rtol=0, atol=1e-3)
    assert result[:3].argmax(1).tolist() == [1, 4, 8]
    gray = noise(0, 64, 192)[..., :1].repeat(3, 2)
    encoded = method.encode_query(frames([gray])).view(32, 64).numpy()
    expected = plain_picture(gray[..., 0], 32, 64)
    np.testing.assert_allclose(encoded, expected, rtol=0, atol=1e-5)


def test_a_reference_unlike_all_others_keeps_a_score():
    difference = torch.full((1, 9000), 0.5)
    difference[0, 7] = 50.0
    scores = enhance(difference, torch.zeros(9000, dtype=torch.int64))
    assert scores.isfinite().all()
    assert scores.argmin() == 7
