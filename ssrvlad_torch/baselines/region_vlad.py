"""Region-VLAD (Khaliq, Ehsan, Chen, Milford, McDonald-Maier, T-RO 2019) as a method."""

from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import View, picture_of
from .region_features import RegionFeatures
from .vectors import VectorMethod
from .vocabulary import CHANNELS, read_vocabulary
from .weights import find_weights

_ORIGIN = (
    "the authors (github.com/Ahmedest61/CNN-Region-VLAD-VPR, folder Vocabulary), "
    "or trained with train_vocabulary"
)


class RegionVLAD(VectorMethod):
    """VLAD of an image's regions over a vocabulary, compared by the cosine.

    ``regions`` and ``words`` are N and V of the paper: 400 and 256, or 200 and 128. For weights,
    also random ones, see `RegionFeatures`; the vocabulary is ``region_vlad_vocabulary.npy`` or
    another file for `read_vocabulary`, found by `find_weights`.
    """

    needs = frozenset({"images", "weights"})

    def __init__(
        self,
        weights: str | Path | None = None,
        vocabulary: str | Path | None = None,
        random_weights: bool = False,
        regions: int = 400,
        words: int = 256,
        device: str = "cpu",
    ) -> None:
        self.name = "region-vlad (random weights)" if random_weights else "region-vlad"
        self._features = RegionFeatures(weights, random_weights, regions, device)
        if random_weights:
            random = torch.Generator().manual_seed(0)
            self._words = torch.rand(words, CHANNELS, generator=random)
        else:
            published = f"Vocabulary_{400 if regions == 400 else '100_200_300'}.pkl"
            path = find_weights(vocabulary, ("region_vlad_vocabulary.npy", published), _ORIGIN)
            self._words = read_vocabulary(path, words, regions)
        self.length = self._words.numel()

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        images = (picture_of(view, self.name) for view in views)
        return torch.stack([vlad(regions, self._words) for regions in self._features(images)])


def vlad(descriptors: Tensor, words: Tensor) -> Tensor:
    """Vector of locally aggregated descriptors (Jegou et al., CVPR 2010) with signed square root.
    ``(R, D)`` descriptors and ``(V, D)`` words give ``(V * D,)`` float of length 1, or zeros if
    there are no descriptors."""
    nearest = torch.cdist(descriptors, words).argmin(1)
    residuals = torch.zeros_like(words).index_add_(0, nearest, descriptors - words[nearest])
    rooted = residuals.sign() * residuals.abs().sqrt()
    return F.normalize(rooted.flatten(), dim=0)
