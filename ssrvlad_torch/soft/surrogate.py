"""The descriptor to train through: the numbers of the method, the gradient of its twin."""

import torch
from torch import Tensor, nn

from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from .descriptor import SoftSSRVLAD


class SurrogateSSRVLAD(nn.Module):
    """`SSRVLAD` with the gradient of `SoftSSRVLAD` at temperature 1.

    Args:
        config: the settings, as for `SoftSSRVLAD`.

    Shape:
        - input: ``(B, C, H, W)`` floating class scores; without a gradient, whatever `SSRVLAD`
          takes.
        - output: ``(B, D)`` float32, the descriptors of `SSRVLAD`.

    Raises:
        ValueError: as `SoftSSRVLAD` and `SSRVLAD`.
    """

    def __init__(self, config: SSRVLADConfig | None = None) -> None:
        super().__init__()
        self.exact, self.soft = SSRVLAD(config), SoftSSRVLAD(config)

    def forward(self, scores: Tensor) -> Tensor:
        """The descriptors of a batch."""
        exact: Tensor = self.exact(scores.detach())
        if not (scores.requires_grad and torch.is_grad_enabled()):
            return exact
        soft: Tensor = self.soft(scores)
        return exact + (soft - soft.detach()).float()
