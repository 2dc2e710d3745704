"""``ssrvlad vocabulary``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..options import Weights
from ..output import say


def vocabulary(
    images: Annotated[Path, typer.Argument(help="Folder of images, and of folders of images.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The .npy file to write.")],
    weights: Weights = None,
    words: Annotated[int, typer.Option(min=1, help="Words, 256 or 128 in the paper.")] = 256,
    regions: Annotated[
        int, typer.Option(min=1, help="Regions of an image, 400 or 200 in the paper.")
    ] = 400,
    seed: Annotated[int, typer.Option(min=0, help="Of the choice of the first words.")] = 0,
) -> None:
    """Train a vocabulary of Region-VLAD on images, by k-means over their regions.

    Example: ssrvlad vocabulary photos -o vocabulary.npy --weights alexnet_places365.caffemodel
    """
    from ...baselines.region_features import RegionFeatures
    from ...baselines.vocabulary import train_vocabulary

    features = RegionFeatures(weights, regions=regions)
    train_vocabulary(images, output, features, words, seed)
    say(f"{output}: {words} words")
