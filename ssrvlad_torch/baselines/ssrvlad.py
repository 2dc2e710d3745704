"""SSR-VLAD as a method."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..recognition.sweep import COLUMNS
from ..recognition.temporal import temporal_sum
from .protocol import Frame, batches, label_kind, labels_of, noting
from .vectors import VectorMethod


class SSRVLADMethod(VectorMethod):
    """Raw descriptors of queries, which may have different label spaces, against references summed
    over ``temporal`` frames on each side inside a sequence (t of Eq. 3); ``settings`` are fields of
    `SSRVLADConfig` that replace those of the preset."""

    name = "ssr-vlad"
    needs = frozenset({"labels"})
    _kind = staticmethod(label_kind)

    def __init__(self, preset: str = "default", temporal: int = 0, **settings: Any) -> None:
        if temporal < 0:
            raise ValueError(f"method ssr-vlad: temporal must be 0 or more, got {temporal}")
        self.config = SSRVLADConfig.from_preset(preset, **settings)
        self.temporal, self.length = temporal, self.config.length
        self._heads: dict[str, SSRVLAD] = {}

    @torch.no_grad()
    def encode_sweep(self, frames: Iterable[Frame]) -> Tensor:
        """``(Q, S, 480)`` float32; for residuals, which have no anchor, ``(Q, 480)``."""
        if self.config.aggregation != "harmonics":
            return self.encode_query(frames)
        grouped = batches(frames, self._batch, self._kind)
        descriptors = [self._describe(batch, COLUMNS) for batch in grouped]
        return torch.cat([torch.zeros(0, len(COLUMNS), self.config.length), *descriptors])

    def encode_reference(self, frames: Iterable[Frame]) -> Tensor:
        """``(R, 480)`` float32, after Eq. 3."""
        sequences: list[str] = []
        return temporal_sum(self.encode_query(noting(frames, sequences)), sequences, self.temporal)

    def _describe(self, frames: Sequence[Frame], columns: Sequence[int] = ()) -> Tensor:
        maps, spaces = zip(*(labels_of(frame, self.name) for frame in frames), strict=True)
        if spaces[0] not in self._heads:
            settings = {**self.config.to_dict(), "labels_as": spaces[0]}
            self._heads[spaces[0]] = SSRVLAD(SSRVLADConfig.from_dict(settings))
        head, stacked = self._heads[spaces[0]], torch.from_numpy(np.stack(maps))
        descriptors: Tensor = head.sweep(stacked, columns) if columns else head(stacked)
        return descriptors
