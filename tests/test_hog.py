"""HOG against scikit-image, cell histograms against a loop."""

import numpy as np
import pytest
import torch
from skimage.feature import hog as skimage_hog

from ssrvlad_torch.baselines import Frame, make
from ssrvlad_torch.baselines.hog import CELL, ORIENTATIONS, cell_histograms, central_differences


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


def test_cell_histograms_equal_a_loop():
    rng = np.random.default_rng(0)
    bins, votes = rng.integers(0, 5, (2, 32, 48)), rng.random((2, 32, 48)).astype(np.float32)
    expected = np.zeros((2, 2, 3, 5))
    for b, y, x in np.ndindex(bins.shape):
        expected[b, y // CELL, x // CELL, bins[b, y, x]] += votes[b, y, x]
    found = cell_histograms(torch.from_numpy(bins), torch.from_numpy(votes), 5)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5)


def test_central_differences_are_zero_at_the_border():
    ramp = torch.arange(12.0).view(1, 3, 4)
    along_x, along_y = central_differences(ramp)
    assert along_x[0].tolist() == [[0, 2, 2, 0]] * 3
    assert along_y[0].tolist() == [[0] * 4, [8] * 4, [0] * 4]


def stripes(upright):
    wave = (127 + 120 * np.sin(np.arange(160) / 3)).astype(np.uint8)
    picture = np.broadcast_to(wave if upright else wave[:96, None], (96, 160))
    return np.repeat(picture[..., None], 3, axis=2)


def test_stripes_fall_into_the_bin_of_their_gradient():
    found = make("hog").encode_query(frames([stripes(True), stripes(False)]))
    best = found.view(2, -1, ORIENTATIONS).argmax(2)
    assert (best[0] == 0).all()
    assert (best[1] == ORIENTATIONS // 2).all()


def test_contrast_does_not_matter_and_shape_does():
    image = stripes(True) & 0xFE
    method = make("hog")
    encoded = method.encode_query(frames([image, image // 2, stripes(False)]))
    scores = method.scores(encoded, encoded)
    assert scores[0, 1] > 1 - 1e-5
    assert scores[0, 2] == 0


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
