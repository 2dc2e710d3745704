"""Local Semantic Tensor (Garg, Suenderhauf, Milford, RSS 2018).

The symbols: x_i is the feature vector at place i, l_i its most likely class, m_is the probability
there of class s, mu_s the mean feature of class s. The two equations are those of the paper as
the authors' program (github.com/oravus/lostX, ``LoST.py``) computes them.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def class_sums(features: Tensor, labels: Tensor, classes: Tensor) -> tuple[Tensor, Tensor]:
    """What the mean features of some classes are made of.

    Args:
        features: ``(D, P)`` float, the x_i.
        labels: ``(P,)`` int64, the l_i.
        classes: ``(S,)`` int64, channel numbers.

    Returns:
        ``(S, D)`` sums of the features of each class, ``(S, 1)`` numbers of places.
    """
    members = (labels == classes[:, None]).to(features.dtype)
    return members @ features.mT, members.sum(dim=1, keepdim=True)


def lost_descriptor(features: Tensor, probabilities: Tensor, means: Tensor) -> Tensor:
    """The descriptor of an image.

    Args:
        features: ``(D, P)`` float, the x_i.
        probabilities: ``(S, P)`` float, the m_is.
        means: ``(S, D)`` float, the mu_s; zero for a class that was not seen.

    Returns:
        ``(S * D,)`` of length 1: L_s = sum_i m_is |x_i - mu_s| (Eq. 1), each of length 1, put one
        after another.
    """
    residuals = [
        (features - mean[:, None]).abs() @ weight
        for mean, weight in zip(means, probabilities, strict=True)
    ]
    return F.normalize(F.normalize(torch.stack(residuals), dim=1).flatten(), dim=0)
