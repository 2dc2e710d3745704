"""What a network is given: size, colours, batches."""

import numpy as np
import pytest
import torch
from drawings import SPACE
from helpers import refuses, street
from networks import (
    LABELS,
    NOISE,
    PLAIN,
    Coloured,
    Street,
    Then,
    assert_right,
    colour_network,
    photo,
    write_photos,
)
from PIL import Image

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.segmentation import segmenter as segmentation
from ssrvlad_torch.segmentation.preparation import Preparation, SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter


def test_colours_are_normalised_as_the_settings_say():
    pixels = torch.tensor([[[[255, 0, 51], [0, 102, 255]]]], dtype=torch.uint8)
    rgb = Preparation(SegmenterConfig(mean=(0.5, 0.25, 0), std=(0.5, 0.25, 2)))(pixels)
    bgr = Preparation(
        SegmenterConfig(white=255, mean=(104, 117, 123), std=(1, 1, 2), colour_order="bgr")
    )(pixels)
    np.testing.assert_allclose(rgb[0], [[[1, -1]], [[-1, 0.6]], [[0.1, 0.5]]], atol=1e-6)
    np.testing.assert_allclose(bgr[0], [[[-53, 151]], [[-117, -15]], [[66, -61.5]]], atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({}, (90, 160)),
        ({"multiple": 16}, (96, 160)),
        ({"size": (50, 70), "multiple": 32}, (50, 70)),
        ({"size": 45}, (45, 80)),
        ({"size": 180, "longest": 240}, (135, 240)),
        ({"size": 45, "multiple": 32}, (32, 96)),
    ],
)
def test_a_picture_is_resized_by_size_longest_and_multiple(settings, size):
    config = SegmenterConfig(**settings)
    assert config.network_size(90, 160) == size
    if not isinstance(config.size, tuple):
        assert config.network_size(160, 90) == size[::-1]
    assert Preparation(config)(torch.zeros(1, 90, 160, 3)).shape == (1, 3, *size)


def test_resizing_is_that_of_pillow_but_for_its_rounding():
    for size in ((8, 11), (40, 31)):
        config = SegmenterConfig(size=size, mean=(0, 0, 0), std=(1, 1, 1), white=255)
        resized = Preparation(config)(torch.from_numpy(NOISE)[None])[0].permute(1, 2, 0)
        expected = Image.fromarray(NOISE).resize(size[::-1], Image.Resampling.BILINEAR)
        assert np.abs(resized.numpy() - np.asarray(expected)).max() < 1.01


def test_images_of_like_size_share_a_batch_of_bounded_pixels(monkeypatch):
    sizes = [(24, 32), (24, 32), (30, 20), (24, 32), (24, 32), (30, 20), (24, 32)]
    labels = [street(seed, *size) for seed, size in enumerate(sizes)]
    batches = []
    network = colour_network()
    network.register_forward_pre_hook(lambda module, inputs: batches.append(inputs[0].shape))
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 2 * 24 * 32)
    assert_right(Segmenter(network, SPACE, PLAIN), [photo(one) for one in labels], labels)
    assert sorted(batches) == [(1, 3, 24, 32), (2, 3, 24, 32), (2, 3, 24, 32), (2, 3, 30, 20)]


def test_a_picture_that_fails_in_a_batch_is_tried_alone_and_named(tmp_path):
    class Picky(Coloured):
        def forward(self, images):
            if len(images) > 1 or images.shape[2] % 8:
                raise torch.OutOfMemoryError("one at a time,\nmultiples of 8")
            return self.network(images)

    write_photos(tmp_path / "a", [0, 2])
    write_photos(tmp_path / "a", [1], size=(25, 32))
    files = find_image_files([str(tmp_path / "a")])
    results = [result for _, result in Segmenter(Picky(), SPACE, PLAIN).label_maps(files)]
    np.testing.assert_array_equal(results[0], LABELS[0])
    np.testing.assert_array_equal(results[2], LABELS[2])
    assert str(results[1]) == "the network fails at 25x32: one at a time, multiples of 8"


def test_a_long_picture_is_not_resized_to_any_size():
    segmenter = Segmenter(colour_network(), SPACE, SegmenterConfig(size=2000))
    with pytest.raises(
        ValueError, match="at 1x40, fed at 2000x80000: has 2000 x 80000 pixels; expected at most"
    ):
        segmenter([NOISE[:1].repeat(2, 1)[:, :40]])


@pytest.mark.parametrize("image", [NOISE / 255, NOISE[..., 0], NOISE[:0], NOISE.astype(int)])
def test_arrays_that_are_no_images_are_refused(image):
    with pytest.raises(ValueError, match=r"expected a list of \(H, W, 3\) uint8 images, got"):
        Segmenter(colour_network(), SPACE)([image])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": (0, 5)}, r"size must be height and width .* got \(0, 5\)"),
        ({"size": (5, 5.0)}, "size must be"),
        ({"size": 0}, "size must be .* got 0"),
        ({"longest": 0}, "longest must be"),
        ({"multiple": 1.5}, "multiple must be"),
        ({"white": 0}, "white must be a number above 0, got 0"),
        ({"mean": (0, 0, float("nan"))}, "mean must be three numbers"),
        ({"std": (1, True, 1)}, "std must be three numbers above 0"),
        ({"colour_order": "RGB"}, "colour_order must be rgb or bgr, got 'RGB'"),
        ({"output": 0}, "output must be a name, got 0"),
        ({"classes": (3, 3)}, "classes must be FIRST:LAST"),
        *(
            ({"features": wrong}, "features must be a list of names of activations")
            for wrong in ("a", (), (1,))
        ),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    refuses(message, SegmenterConfig, **settings)


def test_a_failing_network_is_reported_with_the_size_it_was_fed():
    """And what settings may mend it, unless they are given or it fails for another reason."""
    picture = [np.zeros((30, 40, 3), np.uint8)]
    hint = "; a network for one size, or for sides that are multiples of a number, needs size: or m"
    for settings, fed in (({}, ""), ({"size": 90}, ", fed at 90x120")):
        with pytest.raises(ValueError, match=f"fails at 30x40{fed}: Sizes of tensors .*{hint}"):
            Segmenter(Street(), SPACE, PLAIN, **settings)(picture)
    with pytest.raises(ValueError, match=r"fails at 30x40, fed at 90x120: Sizes [^;]*$"):
        Segmenter(Street(), SPACE, PLAIN, size=(90, 120))(picture)
    assert Segmenter(Street(), SPACE, PLAIN, size=90, multiple=16)(picture)
    broken = Then(lambda scores: int("x"))
    refuses(r"fails at 30x40: invalid literal [^;]*$", Segmenter(broken, SPACE, PLAIN), picture)
