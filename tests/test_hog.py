"""HOG against scikit-image, cell histograms against a loop."""

import numpy as np
import pytest
from methods import frames
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
    descriptor = make("hog").encode_query(frames([np.repeat(picture[..., None], 3, axis=2)]))[0]
    np.testing.assert_allclose(
        descriptor.numpy(), blocks / np.linalg.norm(blocks), rtol=0, atol=1e-5
    )
