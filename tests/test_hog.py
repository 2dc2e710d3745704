"""HOG against scikit-image, cell histograms against a loop."""

import numpy as np
import pytest
from methods import frames, noise
from skimage.feature import hog as skimage_hog

from ssrvlad_torch.baselines import make
from ssrvlad_torch.channels.hog import CELL, ORIENTATIONS


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


def test_mirrored_histograms_are_near_those_of_mirrored_pictures():
    """Not equal: a level gradient counts in the first bin in both."""
    pictures = [noise(seed, 96, 160) for seed in (0, 1)]
    method = make("hog")
    found = method.encode_query(frames(pictures))
    assert make("hog", rows=3, columns=4).encode_query(frames(pictures)).shape == (2, 8 * 3 * 4)
    expected = method.encode_query(frames([picture[:, ::-1].copy() for picture in pictures]))
    alike = (method.mirrored(found) * expected).sum(1)
    assert alike.min() > 0.98 and alike.min() > (found * expected).sum(1).max() + 0.01
