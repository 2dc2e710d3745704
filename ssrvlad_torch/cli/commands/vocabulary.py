"""``ssrvlad vocabulary``."""

from __future__ import annotations

from pathlib import Path

from ..options import Weights, argument, option
from ..output import say


def vocabulary(
    *,
    images: Path = argument("Folder of images, and of folders of images."),
    output: Path = option(..., "The .npy file to write.", "--output", "-o"),
    weights: Weights = None,
    words: int = option(256, "Words, 256 or 128 in the paper.", min=1),
    regions: int = option(400, "Regions of an image, 400 or 200 in the paper.", min=1),
    seed: int = option(0, "Of the choice of the first words.", min=0),
) -> None:
    """Train a vocabulary of Region-VLAD on images, by k-means over their regions.

    Example: ssrvlad vocabulary photos -o vocabulary.npy --weights alexnet_places365.caffemodel
    """
    from ...baselines.region_features import RegionFeatures
    from ...baselines.vocabulary import train_vocabulary

    features = RegionFeatures(weights, regions=regions)
    train_vocabulary(images, output, features, words, seed)
    say(f"{output}: {words} words")
