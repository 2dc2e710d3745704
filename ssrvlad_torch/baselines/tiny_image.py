"""The trivial method for images: differences of tiny pictures, normalised over a sequence.

These are the image comparison and the contrast enhancement of SeqSLAM (Milford & Wyeth, ICRA 2012)
over whole sequences of references, without its search over sequences of queries.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import View, batches
from ..channels.gray import grays
from .channel_methods import joined
from .protocol import noting

WIDTH, HEIGHT, PATCH = 64, 32, 8

_BATCH = 16
_SCORES_AT_ONCE = 1 << 20
_LEAST_DEVIATION = 1e-4
_LEAST_Z = -80.0
"""Its exponential fits into a float32, so every reference has a finite score."""


@dataclass(frozen=True)
class References:
    """Encoded references: pictures ``(R, HEIGHT * WIDTH)`` float32, and the number of each frame's
    sequence, ``(R,)`` int64."""

    pictures: Tensor
    sequence: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes of the pictures."""
        return self.pictures.nbytes


class TinyImage:
    """Mean absolute difference of tiny pictures, in deviations from the drive around it.

    A picture is gray, reduced to 64 x 32 by the mean of the area, and each patch of 8 x 8 pixels
    then has its mean subtracted and is divided by its standard deviation (zero where it has none).
    D is the mean absolute difference of a query and a reference. With the mean m and the standard
    deviation s of D over the references of a sequence, the score of its frames is 1 - exp(-(m - D)
    / s), or 0 where all are alike, as in a sequence of one frame. SeqSLAM scores by (m - D) / s
    itself. This form keeps its order, is at most 1, and `recognition.motion.nearness` turns it
    back; from 16 deviations on float32 rounds it to 1.
    """

    name = "tiny-image"
    needs = frozenset({"images"})

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, HEIGHT * WIDTH)`` float32."""
        return joined(map(self._describe, batches(frames, _BATCH)), self.name)

    def encode_reference(self, frames: Iterable[View]) -> References:
        """The pictures, and the sequence of each."""
        sequences: list[str] = []
        pictures = self.encode_query(noting(frames, sequences))
        number = {name: i for i, name in enumerate(dict.fromkeys(sequences))}
        sequence = torch.tensor([number[name] for name in sequences], dtype=torch.int64)
        return References(pictures, sequence)

    @torch.no_grad()
    def scores(self, queries: Tensor, references: References) -> Tensor:
        """``(Q, R)``: differences of the pictures, normalised over each reference sequence."""
        scores = torch.zeros(len(queries), len(references.pictures))
        at_once = max(1, _SCORES_AT_ONCE // len(references.pictures))
        for rows, block in zip(scores.split(at_once), queries.split(at_once), strict=True):
            difference = torch.cdist(block, references.pictures, p=1) / block.shape[1]
            rows.copy_(enhance(difference, references.sequence))
        return scores

    def _describe(self, frames: Sequence[View]) -> Tensor:
        pictures = grays(frames, self.name)[:, None].float()
        tiny = F.interpolate(pictures, (HEIGHT, WIDTH), mode="area")
        return normalise_patches(tiny[:, 0]).flatten(1)


def normalise_patches(pictures: Tensor) -> Tensor:
    """``(B, H, W)`` float pictures, sides multiples of 8, with mean 0 and standard deviation 1 in
    each patch of 8 x 8 pixels; a flat patch is zero."""
    patches = pictures.unflatten(2, (-1, PATCH)).unflatten(1, (-1, PATCH))
    centred = patches - patches.mean((2, 4), keepdim=True)
    deviation = centred.square().mean((2, 4), keepdim=True).sqrt()
    flat = deviation < _LEAST_DEVIATION
    normal: Tensor = centred / deviation.masked_fill(flat, torch.inf)
    return normal.flatten(3).flatten(1, 2)


def enhance(difference: Tensor, sequence: Tensor) -> Tensor:
    """Contrast enhancement of differences ``(Q, R)`` over each sequence of references, whose
    numbers are ``(R,)``: ``(Q, R)`` float32, at most 1, higher for more similar pictures."""
    scores = torch.zeros_like(difference, dtype=torch.float32)
    for number in sequence.unique():
        columns = sequence == number
        within = difference[:, columns].double()
        deviation, mean = torch.std_mean(within, 1, correction=0, keepdim=True)
        flat = deviation < _LEAST_DEVIATION
        z = ((mean - within) / deviation.masked_fill(flat, torch.inf)).clamp(min=_LEAST_Z)
        scores[:, columns] = -torch.expm1(-z).float()
    return scores
