"""The differentiable twin, class scores -> descriptors with a gradient for every score, and exact
descriptors with that gradient."""

import torch
from torch import Tensor, nn

from ..config import SSRVLADConfig
from ..descriptor import SSRVLAD
from ..stages.boundaries import WIDTH
from ..stages.front_end import label_map
from ..stages.grid_pooling import CELLS, ROWS
from ..stages.harmonics import Harmonics
from ..taxonomy import label_space
from .stages import (
    membership,
    soft_boundaries,
    soft_coefficients,
    soft_layers,
    soft_majority,
    soft_merge,
    soft_pool,
    soft_vanishing_columns,
)


class SoftSSRVLAD(nn.Module):
    """Class scores -> place descriptors through which a segmentation network can be trained: each
    step of `SSRVLAD` in real numbers.

    Args:
        config: the settings, of the aggregation ``harmonics``; by default the preset ``default``.
        temperature: it divides the logits. At 1 the descriptor is near the hard one; towards 0 it
            becomes the hard one and gradients vanish; above 1 everything is softer.

    Shape:
        - input: ``(B, C, H, W)`` floating class scores: logits, or probabilities, which are
          recognised by their sums (see `are_probabilities`); any ``H`` and ``W`` from 1.
        - output: ``(B, D)`` float32, float64 for float64 input, of length 1,
          ``D = config.length``, 480 by default; shorter if the image shows almost no category,
          exact zeros if it shows none. Autocast does not change it.

    Raises:
        ValueError: the aggregation is another; the temperature is not above 0; `SSRVLAD` refuses
            the input; the input is a label map, or the largest score of a pixel is infinite.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.soft.descriptor import SoftSSRVLAD
        >>> scores = torch.randn(2, 19, 60, 80, requires_grad=True)
        >>> SoftSSRVLAD()(scores)[0].sum().backward()
    """

    def __init__(self, config: SSRVLADConfig | None = None, temperature: float = 1.0) -> None:
        super().__init__()
        if not 0 < temperature < float("inf"):
            raise ValueError(f"temperature must be a number above 0, got {temperature!r}")
        self.config = config or SSRVLADConfig()
        if self.config.aggregation != "harmonics":
            raise ValueError(
                "a gradient needs the aggregation harmonics, as in the preset default, got "
                f"{self.config.aggregation}"
            )
        self.temperature = temperature
        self._label_space = label_space(self.config.labels_as)
        self._harmonics = Harmonics(self.config)

    def forward(self, scores: Tensor) -> Tensor:
        """The descriptors of a batch."""
        if scores.ndim != 4:
            raise ValueError(f"expected (B, C, H, W) class scores, got {tuple(scores.shape)}")
        with torch.autocast(scores.device.type, enabled=False):
            wide = scores.float() if scores.dtype in (torch.half, torch.bfloat16) else scores
            label_map(wide.detach(), self._label_space)  # refuses wrong input
            infinite = wide.detach().amax(1).isinf()  # they have no softmax
            if bool(infinite.any()):
                raise ValueError(
                    f"class scores of {int(infinite.sum())} pixels are infinite; expected finite "
                    "ones to train through (half precision holds 65504 at most)"
                )
            return self._describe(wide)

    def _describe(self, scores: Tensor) -> Tensor:
        config = self.config
        members = membership(self._label_space, scores.shape[1])
        layers = soft_layers(scores, members, self.temperature)  # Table II
        layers = soft_majority(layers, config.grid(*scores.shape[2:]), self.temperature)
        layers = soft_merge(layers)
        column = layers.new_zeros(len(layers))
        if config.anchor == "vanishing-column":
            column = soft_vanishing_columns(layers)
        bins, basis = (self._harmonics.table(name).to(layers.dtype) for name in ("bins", "basis"))
        area = soft_pool(layers, column, CELLS)
        unit = min(layers.shape[2:]) / ROWS / WIDTH
        lengths = soft_pool(soft_boundaries(layers), column, CELLS) * unit
        numbers = config.harmonics, config.boundary_harmonics
        return soft_coefficients(area, lengths, bins, basis, numbers, config.power)

    def extra_repr(self) -> str:
        """What ``print(twin)`` shows: the temperature."""
        return f"temperature={self.temperature:g}"


class SurrogateSSRVLAD(nn.Module):
    """`SSRVLAD` with the gradient of `SoftSSRVLAD` at temperature 1; settings and errors are
    theirs.

    Shape:
        - input: ``(B, C, H, W)`` floating class scores; without a gradient, whatever `SSRVLAD`
          takes.
        - output: ``(B, D)`` float32, the descriptors of `SSRVLAD`.
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
