"""A painted world, photographs of it, and what the tests of segmentation share."""

import numpy as np
import torch
from helpers import street
from networks import photo, write_graph
from PIL import Image

from ssrvlad_torch.segmentation.preparation import SegmenterConfig

LABELS = [street(seed) for seed in range(5)]
PHOTOS = [photo(labels) for labels in LABELS]
NOISE = np.random.default_rng(0).integers(0, 256, (17, 23, 3), np.uint8)
BYTES = SegmenterConfig(white=255, mean=(0, 0, 0), std=(1, 1, 1))


def assert_right(segmenter, photos=PHOTOS, expected=LABELS):
    for labels, right in zip(segmenter(photos), expected, strict=True):
        np.testing.assert_array_equal(labels, right)
        assert labels.dtype == np.uint8


def write_image(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def write_photos(folder, seeds=range(5), size=(24, 32)):
    for seed in seeds:
        write_image(folder / f"{seed}.png", photo(street(seed, *size)))
    return folder


def write_settings(folder, more=""):
    """``net.onnx``, which labels this world, and ``net.yaml``, its settings."""
    write_graph(folder / "net.onnx")
    path = folder / "net.yaml"
    path.write_text(f"network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n{more}")
    return path


def counted(network):
    """Counts the images that a network is given, in ``network.images``."""
    network.images = torch.zeros((), dtype=torch.int64)

    def count(module, arguments):
        module.images += len(arguments[0])

    network.register_forward_pre_hook(count)
    return network
