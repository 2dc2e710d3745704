"""``ssrvlad vocabulary``."""

from pathlib import Path

from ..options import argument, option
from ..output import say


def vocabulary(
    *,
    images: Path = argument("Folder of images or of folders of images."),
    output: Path = option("File to write (.npy).", "--output", "-o", default=...),
    weights: Path | None = option(
        "Weights of the method's network: a file or its folder. Default: ~/.cache/ssrvlad/weights."
    ),
    words: int = option("Number of words; 256 or 128 in the paper.", default=256, min=1),
    regions: int = option("Regions of each image; 400 or 200 in the paper.", default=400, min=1),
    seed: int = option("Another seed gives other initial words.", default=0, min=0),
) -> None:
    """Train the vocabulary of Region-VLAD by k-means over the regions of images.

    Example: ssrvlad vocabulary photos -o vocabulary.npy --weights alexnet_places365.caffemodel
    """
    from ...baselines.region_features import RegionFeatures
    from ...baselines.vocabulary import train_vocabulary

    features = RegionFeatures(weights, regions=regions)
    train_vocabulary(images, output, features, words, seed)
    say(f"{output}: {words} words")
