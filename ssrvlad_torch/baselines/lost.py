"""Local Semantic Tensor, and the layout of keypoints (Garg, Suenderhauf, Milford, RSS 2018).

x_i is the feature vector at place i, m_is the probability of class s there, mu_s the mean feature
of class s. The equations are those of the paper, as the authors' program (github.com/oravus/lostX,
``LoST.py``) computes them. The layout is that of the program (``match_lost_kc.py``): the paper
removes keypoints that are close together and uses weighted Euclidean distances, but does not define
every step.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor


def layout_cost(columns: tuple[Tensor, Tensor], distances: Tensor) -> float:
    """Cost of M pairs of keypoints, low if they keep their order along the image; infinity for
    fewer than two pairs. ``columns`` are x of the keypoints in both images, ``(M,)`` float each,
    and ``distances`` ``(M,)`` float the cosine distances between the features of each pair.

    The weight of a pair is the largest distance minus its own, after all are divided by their sum;
    if all distances are equal, so are the weights. The cost is the cosine distance between the two
    vectors of weighted columns, divided by the length of the weights and by M.
    """
    count = len(columns[0])
    if count < 2:
        return math.inf
    fractions = F.normalize(distances.double(), p=1, dim=0)
    weights = fractions.max() - fractions
    if not bool(weights.any()):
        weights = torch.full_like(weights, 1 / count)
    first, second = (weights * side.double() for side in columns)
    distance = 1 - F.cosine_similarity(first, second, dim=0)
    return float(distance.clamp(min=0) / weights.norm() / count)


def class_sums(features: Tensor, labels: Tensor, classes: Tensor) -> tuple[Tensor, Tensor]:
    """The parts of the mean features of classes ``(S,)`` int64, channel numbers: sums ``(S, D)`` of
    the features ``(D, P)`` float of each class, and numbers of places ``(S, 1)``, by labels
    ``(P,)`` int64."""
    members = (labels == classes[:, None]).to(features.dtype)
    return members @ features.mT, members.sum(dim=1, keepdim=True)


def lost_descriptor(features: Tensor, probabilities: Tensor, means: Tensor) -> Tensor:
    """The descriptor of an image, ``(S * D,)`` of length 1: L_s = sum_i m_is |x_i - mu_s| (Eq. 1),
    each normalised to length 1, concatenated; of features ``(D, P)``, probabilities ``(S, P)`` and
    means ``(S, D)``, zero for a class without places."""
    residuals = [
        (features - mean[:, None]).abs() @ weight
        for mean, weight in zip(means, probabilities, strict=True)
    ]
    return F.normalize(F.normalize(torch.stack(residuals), dim=1).flatten(), dim=0)
