"""HOG against scikit-image, cell histograms against a loop."""

import numpy as np
import pytest
import torch
from skimage.feature import hog as skimage_hog

from ssrvlad_torch.baselines import Frame, make
from ssrvlad_torch.baselines.hog import CELL, ORIENTATIONS


def noise(seed, height=96, width=160):
    """A smooth random gray image, in colour."""
    small = np.random.default_rng(seed).integers(0, 256, (height // 4, width // 4), dtype=np.uint8)
    return np.repeat(np.kron(small, np.ones((4, 4), np.uint8))[..., None], 3, axis=2)


def frames(images):
    return [Frame(f"a/{i}", image=image) for i, image in enumerate(images)]


@pytest.mark.parametrize("seed", range(3))
def test_hog_is_that_of_scikit_image(seed):
    """On images of the working size; the epsilon of its norms is of no weight here."""
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (96, 160), dtype=np.uint8)
    blocks = skimage_hog(
        picture.astype(float),
        orientations=ORIENTATIONS,
        pixels_per_cell=(CELL, CELL),
        cells_per_block=(1, 1),
        block_norm="L2",
    )
    found = make("hog").encode_query(frames([np.repeat(picture[..., None], 3, axis=2)]))[0]
    np.testing.assert_allclose(found.numpy(), blocks / np.linalg.norm(blocks), rtol=0, atol=1e-5)


def test_a_flat_image_matches_nothing():
    method = make("hog")
    encoded = method.encode_reference(frames([np.full((50, 60, 3), 9, np.uint8), noise(0)]))
    assert not encoded[0].any()
    scores = method.scores(encoded, encoded)
    assert torch.equal(scores.isinf(), torch.tensor([[True, True], [True, False]]))


def test_a_batch_equals_one_by_one_whatever_the_sizes():
    images = [noise(i, *((96, 160) if i % 5 else (60, 48))) for i in range(20)]
    method = make("hog")
    together = method.encode_query(iter(frames(images)))
    assert (together.shape, together.dtype) == ((20, 480), torch.float32)
    single = torch.cat([method.encode_query([frame]) for frame in frames(images)])
    assert torch.equal(together, single)
    torch.testing.assert_close(together.norm(dim=1), torch.ones(20))
    assert torch.equal(method.encode_reference(frames(images)), together)


def test_the_grid_is_a_setting():
    assert make("hog", rows=3, columns=4).encode_query(frames([noise(0)])).shape == (1, 96)


def test_mirrored_histograms_are_near_those_of_mirrored_pictures():
    """Not equal: a level gradient counts in the first bin in both."""
    pictures = [
        np.random.default_rng(seed).integers(0, 256, (96, 160, 3), np.uint8) for seed in (0, 1)
    ]
    method = make("hog")
    found = method.encode_query(frames(pictures))
    expected = method.encode_query(frames([each[:, ::-1].copy() for each in pictures]))
    alike = (method.mirrored(found) * expected).sum(1)
    assert alike.min() > 0.98 and alike.min() > (found * expected).sum(1).max() + 0.01
