"""Metrics of a segmentation network: mIoU, and RecallRate@1 of its label maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from _train_data import Drive, normalise
from _train_loop import BATCH, confusion, describe
from torch import Tensor, nn

from ssrvlad_torch import SSRVLAD, match
from ssrvlad_torch.evaluation.bootstrap import bootstrap

RESAMPLES = 2000
NEAR = 1
"""Frames this near are a true match."""

Estimate = tuple[float, tuple[float, float]]
"""A figure and the ends of its interval."""


class Outcome(NamedTuple):
    """Results of each of n frames.

    Attributes:
        counts: ``(n, 11, 11)`` int64 pixels by label and prediction.
        odd_even: ``(n,)`` bool, whether the first of the label maps of the frames of the other
            parity is a neighbour's.
        any_frame: ``(n,)`` bool, whether the first of all label maps is the frame's own or a
            neighbour's.
        own: ``(n,)`` float32, the cosine of the prediction and the frame's own label map.
    """

    counts: Tensor
    odd_even: Tensor
    any_frame: Tensor
    own: Tensor


def outcome(predicted: Tensor, drive: Drive, head: SSRVLAD) -> Outcome:
    """Searches each of the ``(n, H, W)`` predicted label maps of a drive among those made by
    hand."""
    references, queries = describe(head, drive.labels), describe(head, predicted)
    frame = torch.arange(len(queries))
    odd_even = torch.zeros(len(queries), dtype=torch.bool)
    for parity in (0, 1):
        own, others = frame[parity::2], frame[1 - parity :: 2]
        _, rows = match(queries[own], references[others], top=1)
        odd_even[own] = (others[rows[:, 0]] - own).abs() <= NEAR
    _, rows = match(queries, references, top=1)
    any_frame = (rows[:, 0] - frame).abs() <= NEAR
    own_cosines = (queries * references).sum(1)
    return Outcome(confusion(predicted, drive.labels), odd_even, any_frame, own_cosines)


@torch.no_grad()
def predict_at_size(network: nn.Module, drive: Drive) -> Tensor:
    """``(n, H, W)`` uint8 labels at the size of the drive's label maps."""
    network.eval()
    found = []
    for part in drive.images.split(BATCH):
        scores = network(normalise(part.permute(0, 3, 1, 2).float() / 255))
        size = drive.labels.shape[1:]
        enlarged = F.interpolate(scores, size=size, mode="bilinear", align_corners=False)
        found.append(enlarged.argmax(1).byte())
    return torch.cat(found)


Figure = Callable[[Outcome, np.ndarray], np.ndarray]
"""``(B,)`` figures of an outcome and of ``(B, n)`` weights of its frames."""


def miou(found: Outcome, weights: np.ndarray) -> np.ndarray:
    """Mean over the classes that occur of intersection over union."""
    counts = np.tensordot(weights, found.counts.double().numpy(), 1)
    both = np.diagonal(counts, axis1=1, axis2=2)
    labelled = counts.sum(2)
    union = labelled + counts.sum(1) - both
    there = labelled > 0
    return np.where(there, both / np.maximum(union, 1), 0).sum(1) / there.sum(1)


def odd_even_recall(found: Outcome, weights: np.ndarray) -> np.ndarray:
    """RecallRate@1 against frames of the other parity."""
    return weights @ found.odd_even.double().numpy() / weights.sum(1)


def any_frame_recall(found: Outcome, weights: np.ndarray) -> np.ndarray:
    """RecallRate@1 against all frames."""
    return weights @ found.any_frame.double().numpy() / weights.sum(1)


def own_cosine(found: Outcome, weights: np.ndarray) -> np.ndarray:
    """Mean cosine of a prediction and its own label map."""
    return weights @ found.own.double().numpy() / weights.sum(1)


FIGURES: dict[str, Figure] = {
    "mIoU": miou,
    "RecallRate@1, odd-even": odd_even_recall,
    "RecallRate@1, any frame": any_frame_recall,
    "cosine to own labels": own_cosine,
}


def estimates(
    outcomes: Sequence[Outcome], against: Sequence[Outcome] | None = None
) -> dict[str, Estimate]:
    """The mean of each figure over the seeds, or its difference to that of others, with 95 %
    bootstrap intervals over the frames; all seeds use the same resampled frames."""

    def figures(weights: np.ndarray) -> dict[str, np.ndarray]:
        return {
            name: _mean(figure, outcomes, weights)
            - (_mean(figure, against, weights) if against else 0)
            for name, figure in FIGURES.items()
        }

    frames = len(outcomes[0].counts)
    ends = bootstrap(figures, frames, RESAMPLES)
    return {
        name: (float(value[0]), ends[name]) for name, value in figures(np.ones((1, frames))).items()
    }


def _mean(figure: Figure, outcomes: Sequence[Outcome], weights: np.ndarray) -> np.ndarray:
    return np.mean([figure(found, weights) for found in outcomes], axis=0)
