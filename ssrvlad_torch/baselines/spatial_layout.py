"""How well the keypoints of two images agree (Garg, Suenderhauf, Milford, RSS 2018).

The paper and the authors' program (github.com/oravus/lostX, ``match_lost_kc.py``) differ here:
the paper thins out keypoints that crowd together and takes weighted Euclidean distances, the
program does neither. The program is followed, because every step of it is defined.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor


def layout_cost(columns: tuple[Tensor, Tensor], distances: Tensor) -> float:
    """Cost of M pairs of keypoints, low where they keep their order along the image.

    A pair weighs the more, the nearer its features are: w_k is the largest of the distances less
    that of the pair, all of them divided by their sum; equal weights where all pairs are equally
    near. The cost is the cosine distance between the two vectors of weighted
    columns, over the length of w and over M.

    Args:
        columns: x of the keypoints in the one image and the other, ``(M,)`` float each.
        distances: ``(M,)`` float, cosine distances between the features at each pair.

    Returns:
        a number of at least 0; infinity for fewer than two pairs, which have no layout.
    """
    count = len(columns[0])
    if count < 2:
        return math.inf
    fractions = F.normalize(distances.double(), p=1, dim=0)
    weights = fractions.max() - fractions
    if not bool(weights.any()):
        weights = torch.full_like(weights, 1 / count)
    one, other = (weights * side.double() for side in columns)
    apart = 1 - F.cosine_similarity(one, other, dim=0)
    return float(apart.clamp(min=0) / weights.norm() / count)
