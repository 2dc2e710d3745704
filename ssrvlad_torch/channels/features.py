"""Features: what the encoder of the network sees in a picture, as signs; see `stages.features`."""

from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor

from ..descriptor import SSRVLAD
from ..stages.features import FORM, SHAPE
from .channel import FEATURES, Channel, Network, View


class Features(Channel):
    """The features of the network with a fingerprint, which views hold."""

    name, shape, dtype = "features", SHAPE, "uint8"
    needs = frozenset({FEATURES})
    trust = 6.0

    def __init__(self, fingerprint: str) -> None:
        self.fingerprint = fingerprint

    @classmethod
    def lacks(cls, network: Network | None) -> str:
        """See `Channel`."""
        if network is None:
            return "features are of a network: expected images and a segmenter"
        return network.problem_of_features

    @classmethod
    def of(cls, _head: SSRVLAD, fingerprint: str) -> Self:
        """See `Channel`."""
        return cls(fingerprint if fingerprint.startswith(FORM) else FORM)

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        for view in views:
            if view.features is None or np.shape(view.features) != SHAPE:
                got = "none" if view.features is None else np.shape(view.features)
                raise ValueError(f"frame {view.frame}: expected features {SHAPE}, got {got}")
        return torch.from_numpy(np.stack([np.asarray(view.features) for view in views]))
