"""Gray pictures against Pillow, and their resizing against OpenCV, bit for bit."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.baselines.gray import grays, resize


def noise(seed, *shape):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_gray_is_that_of_pillow():
    image = noise(0, 300, 400, 3)
    expected = np.asarray(Image.fromarray(image).convert("L"))
    np.testing.assert_array_equal(grays([Frame("a/0", image=image)], "hog")[0].numpy(), expected)


def test_frames_of_one_size_become_one_tensor():
    frames = [Frame(f"a/{i}", image=noise(i, 6, 7, 3)) for i in range(3)]
    together = grays(frames, "hog")
    assert (together.shape, together.dtype) == ((3, 6, 7), torch.uint8)
    assert torch.equal(together[1], grays(frames[1:2], "hog")[0])
    with pytest.raises(ValueError, match="method hog needs images, but frame a/9 has none"):
        grays([*frames, Frame("a/9")], "hog")


@pytest.mark.parametrize("after", [(512, 512), (100, 100), (96, 160), (1, 1)])
@pytest.mark.parametrize(
    "before",
    [(120, 160), (360, 480), (512, 512), (1024, 1000), (77, 80), (999, 13), (2, 3), (1, 5), (1, 1)],
)
def test_resize_is_that_of_opencv(before, after):
    pictures = np.stack([noise(1, *before), np.full(before, 255, np.uint8)])
    found = resize(torch.from_numpy(pictures), *after)
    assert (found.shape, found.dtype) == ((2, *after), torch.uint8)
    for picture, resized in zip(pictures, found, strict=True):
        expected = cv2.resize(picture, after[::-1], interpolation=cv2.INTER_LINEAR)
        np.testing.assert_array_equal(resized.numpy(), expected.reshape(after))
