"""SSR-VLAD as a method."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from ..channels.channel import View, batches
from ..channels.label_shapes import LabelShapes
from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..recognition.sweep import COLUMNS
from ..recognition.temporal import temporal_sum
from .protocol import noting
from .vectors import VectorMethod


class SSRVLADMethod(VectorMethod, LabelShapes):
    """Raw descriptors of queries, which may have different label spaces, against references summed
    over ``temporal`` frames on each side inside a sequence (t of Eq. 3); ``settings`` are fields of
    `SSRVLADConfig` that replace those of the preset."""

    def __init__(self, preset: str = "default", temporal: int = 0, **settings: Any) -> None:
        if temporal < 0:
            raise ValueError(f"method ssr-vlad: temporal must be 0 or more, got {temporal}")
        super().__init__(SSRVLAD(SSRVLADConfig.from_preset(preset, **settings)))
        self.temporal = temporal

    @torch.no_grad()
    def encode_sweep(self, frames: Iterable[View]) -> Tensor:
        """``(Q, S, D)`` float32, ``D = config.length``, 480 by default; for residuals, which have
        no anchor, ``(Q, D)``."""
        if self.config.aggregation != "harmonics":
            return self.encode_query(frames)
        grouped = batches(frames, self._batch)
        descriptors = [self.describe(batch, COLUMNS) for batch in grouped]
        return torch.cat([torch.zeros(0, len(COLUMNS), self.length), *descriptors])

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, D)`` float32, after Eq. 3."""
        sequences: list[str] = []
        return temporal_sum(self.encode_query(noting(frames, sequences)), sequences, self.temporal)
