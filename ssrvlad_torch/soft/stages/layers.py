"""Soft layers: class scores -> probabilities of the eight categories (Table II)."""

import torch
from torch import Tensor

from ...taxonomy import CATEGORIES, LabelSpace

TINY = 1e-6
"""Added to a probability before its logarithm, so that probability 0 has a finite score."""

TOLERANCE = 0.01
"""How far probabilities may be below 0, and their sum away from 1: bfloat16 has three digits."""


def membership(space: LabelSpace, channels: int) -> Tensor:
    """``(C, 8)`` float64, 1 where the class of a channel has the category; rows of dynamic and void
    classes are zero. Channel ``c`` stands for id ``c``."""
    categories = {label.id: label.category_index for label in space.classes}
    columns = torch.tensor([categories[channel] for channel in range(channels)])
    return torch.eye(len(CATEGORIES) + 1).double()[columns, : len(CATEGORIES)]


def soft_layers(scores: Tensor, members: Tensor, temperature: float) -> Tensor:
    """The probability of every category at every pixel, ``(B, 8, H, W)``, the sum over its classes
    by `membership`; the rest to 1 belongs to no layer. Scores ``(B, C, H, W)`` are logits, which
    the temperature divides, or probabilities, which count by their logarithm (see
    `are_probabilities`); if these sum to less than 1, the rest is void."""
    if are_probabilities(scores):
        missing = 1 - scores.sum(1, keepdim=True)
        missing = missing.where(missing > TOLERANCE, 0)
        scores = (torch.cat([scores.clamp(min=0), missing], 1) + TINY).log()
    classes = (scores / temperature).softmax(1)[:, : len(members)]
    return torch.einsum("bchw,ck->bkhw", classes, members.to(classes))


def soft_merge(layers: Tensor) -> Tensor:
    """``(B, 8, h, w)`` layers -> ``(B, 6, h, w)``, see `merge`."""
    ground, sidewalk, building, pole, vegetation, sky, rail, parking = layers.unbind(1)
    return torch.stack((ground + parking, sidewalk, building + rail, pole, vegetation, sky), 1)


def are_probabilities(scores: Tensor) -> bool:
    """Whether ``(B, C, H, W)`` scores are probabilities: none is below 0, and they sum to 1 or, at
    pixels without a class, to less. One-hot labels are probabilities too."""
    with torch.no_grad():
        totals = scores.sum(1)
        whole = (totals.amax() - 1).abs() <= TOLERANCE
        return bool(whole & (scores.amin() >= -TOLERANCE))
