"""Label shapes: the descriptor of a label map, SSR-VLAD's or ours."""

import dataclasses
from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor

from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..taxonomy import LabelSpace, label_space
from .channel import LABELS, Channel, View, labels_of

TORCH_THREADS = 2
"""Threads of the stages in torch: their many short operators wait for Python's global lock, which
the native core and the decoders of images release."""


class LabelShapes(Channel):
    """The descriptors of a head, on its device. Views may have other label spaces than the head:
    their descriptors compare."""

    name = "ssr-vlad"
    needs = frozenset({LABELS})

    def __init__(self, head: SSRVLAD | None = None) -> None:
        self.head = head or SSRVLAD()
        self.config: SSRVLADConfig = self.head.config
        self.shape, self.fingerprint = (self.config.length,), self.config.fingerprint
        self._heads: dict[str, SSRVLAD] = {}

    @property
    def threads(self) -> int | None:  # type: ignore[override]
        """See `Channel`."""
        if next(self.head.buffers()).device.type != "cpu":
            return 0
        return None if self.head.native else TORCH_THREADS

    @classmethod
    def of(cls, head: SSRVLAD, _fingerprint: str) -> Self:
        """See `Channel`."""
        return cls(head)

    @torch.no_grad()
    def describe(self, views: Sequence[View], columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`; the residuals of ``paper`` have no anchor, and no sweep."""
        maps, spaces = zip(*(labels_of(view, self.name) for view in views), strict=True)
        head = self._head(spaces[0])
        stack = torch.from_numpy(np.stack(maps)).to(next(head.buffers()).device)
        swept = columns and self.config.aggregation == "harmonics"
        return (head.sweep(stack, columns) if swept else head(stack)).cpu()

    def _head(self, labels_as: str | LabelSpace) -> SSRVLAD:
        """The head for a label space."""
        space = label_space(labels_as)
        if space == self.head.label_space:
            return self.head
        if space.digest not in self._heads:
            device = next(self.head.buffers()).device
            config = dataclasses.replace(self.config, labels_as=space)
            self._heads[space.digest] = SSRVLAD(config).to(device)
        return self._heads[space.digest]
