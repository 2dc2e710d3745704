"""Vocabularies of Region-VLAD: reading and training."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..datasets.image_files import Pixels, decode_image
from ..evaluation.object_arrays import load_pickle
from ..files import read_bytes, replacing, requiring
from .region_features import RegionFeatures

CHANNELS = 384
"""Channels of conv3, the length of a word."""

_NPY = b"\x93NUMPY"
_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".ppm")


def read_vocabulary(path: Path, words: int = 256, regions: int = 400) -> Tensor:
    """The words of a vocabulary, V and N of the paper, ``(words, 384)`` float32: of a ``.npy``
    file, or the authors' pickle (``Vocabulary_400.pkl`` and ``Vocabulary_100_200_300.pkl``) of
    fitted ``KMeans`` objects of scikit-learn by regions, words and layer. Only the cluster centres
    are read: this does not need scikit-learn and runs no code, see `load_pickle`. Another content
    is a ValueError."""
    with path.open("rb") as file:
        start = file.read(len(_NPY))
    try:
        array = np.load(path) if start == _NPY else _centres(path, words, regions)
        vocabulary = torch.from_numpy(np.asarray(array, np.float32))
    except (ValueError, TypeError, EOFError, AttributeError) as error:
        raise ValueError(f"{path} is not a whole vocabulary: {error}") from error
    if vocabulary.shape != (words, CHANNELS) or not bool(vocabulary.isfinite().all()):
        expected = f"{path} must hold a vocabulary ({words}, {CHANNELS}) of finite numbers"
        raise ValueError(f"{expected}, got {tuple(vocabulary.shape)}")
    return vocabulary


def train_vocabulary(
    folder: str | Path,
    path: str | Path,
    features: RegionFeatures,
    words: int = 256,
    seed: int = 0,
) -> Tensor:
    """Clusters the regions of all images of a folder and those in it with k-means, writes the
    centres to a ``.npy`` file and returns them, ``(words, 384)`` float32.

    The authors used 2,600 images of many places. Every region needs 1.5 kB of memory, an image 0.6
    MB. The network of ``features`` must be the one that will be used; the seed is of the choice of
    the first centres. No image, one that `decode_image` refuses, as what looks like a label map,
    and too few regions are a ValueError; without scikit-learn it is an ImportError.
    """
    regions = list(features(_images(Path(folder))))
    if not regions:
        raise ValueError(f"no images under {folder}; expected files with {', '.join(_SUFFIXES)}")
    with requiring("eval", "a vocabulary needs"):
        from sklearn.cluster import KMeans
        from sklearn.exceptions import ConvergenceWarning
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", ConvergenceWarning)  # fewer distinct points than words
            clusters = KMeans(words, n_init=1, random_state=seed).fit(torch.cat(regions).numpy())
    except (ValueError, ConvergenceWarning) as error:
        raise ValueError(f"{words} words need as many distinct regions: {error}") from error
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.save(file, clusters.cluster_centers_)
    return torch.from_numpy(clusters.cluster_centers_)


def _images(folder: Path) -> Iterator[Pixels]:
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in _SUFFIXES:
            content = read_bytes(path)
            try:
                yield decode_image(content)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from error


def _centres(path: Path, words: int, regions: int) -> Any:
    with path.open("rb") as file:
        entry = load_pickle(file)
    for key in (regions, words, "conv3"):
        if not isinstance(entry, dict) or not {key, str(key)} & entry.keys():
            keys = [*entry] if isinstance(entry, dict) else type(entry).__name__
            raise ValueError(f"expected an entry {key}, got {keys}")
        entry = entry[key] if key in entry else entry[str(key)]
    centres = entry.cluster_centers_
    return np.reshape(centres.values, centres.shape)
