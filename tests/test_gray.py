"""Gray pictures against Pillow, and their resizing against OpenCV, bit for bit."""

import cv2
import numpy as np
import pytest
import torch
from methods import frames, noise
from PIL import Image

from ssrvlad_torch.channels.gray import grays, resize


def test_gray_is_that_of_pillow_and_frames_of_one_size_become_one_tensor():
    drive = frames(noise(seed, 30, 40) for seed in range(3))
    together = grays(drive, "hog")
    assert together.dtype == torch.uint8
    expected = [np.asarray(Image.fromarray(frame.picture).convert("L")) for frame in drive]
    np.testing.assert_array_equal(together.numpy(), expected)


@pytest.mark.parametrize("after", [(512, 512), (100, 100), (96, 160), (1, 1)])
@pytest.mark.parametrize(
    "before",
    [(120, 160), (360, 480), (512, 512), (1024, 1000), (77, 80), (999, 13), (2, 3), (1, 5), (1, 1)],
)
def test_resize_is_that_of_opencv(before, after):
    pictures = np.stack([noise(1, *before)[..., 0], np.full(before, 255, np.uint8)])
    result = resize(torch.from_numpy(pictures), *after)
    assert (result.shape, result.dtype) == ((2, *after), torch.uint8)
    for picture, resized in zip(pictures, result, strict=True):
        expected = cv2.resize(picture, after[::-1], interpolation=cv2.INTER_LINEAR)
        np.testing.assert_array_equal(resized.numpy(), expected.reshape(after))
