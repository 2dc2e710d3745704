"""The settings of the paper's method in pixels of a grid, by the integer rules of `SSRVLADConfig`.

Under export the size of the grid is a symbol, and a length, an area or a squared distance times a
fraction is a product of whole numbers of up to sixty bits, which some runtimes cut to 32 silently.
So it is divided in two steps, as by hand, see `divided`."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..config import SSRVLADConfig
from .tracing import divided, exporting

_MILLION = 10**6
_BILLION = 10**9
_BASE = 1 << 12

Length = int | Tensor
"""An integer; under export ``()`` int32."""


class Lengths(NamedTuple):
    """Radii, areas and squared distances in pixels of a grid."""

    opening: Length
    closing: Length
    hole_area: Length
    region_area: Length
    ring_limits: Sequence[Length]


def lengths(config: SSRVLADConfig, height: int, width: int) -> Lengths:
    """`SSRVLADConfig.radius_pixels`, `area_pixels` and `ring_limits` of a grid. What is 0 on every
    grid is the integer 0."""
    radii, areas = (config.opening, config.closing), (config.hole_area, config.region_area)
    if not exporting():
        pixels = [config.radius_pixels(fraction, height, width) for fraction in radii]
        pixels += [config.area_pixels(fraction, height, width) for fraction in areas]
        return Lengths._make([*pixels, config.ring_limits(height, width)])
    h, w = (torch.full((), size).int() for size in (height, width))
    parts = [config.radius_pixels(fraction, _MILLION, _MILLION) for fraction in radii]
    floors = _floors(torch.minimum(h, w), parts, _MILLION, _MILLION // 2)
    parts = [config.area_pixels(fraction, 1, _MILLION) for fraction in areas]
    floors += _floors(h * w, parts, _MILLION, _MILLION - 1)
    limits = config.ring_limits(30_000, 10_000)  # the squares of these sides sum to a billion
    return Lengths._make([*floors, _floors(h * h + w * w, limits, _BILLION)])


def _floors(amount: Tensor, fractions: Sequence[int], unit: int, offset: int = 0) -> list[Length]:
    """``(fractions * amount + offset) / unit``, rounded down, and 0 for a fraction of 0. The amount
    is ``()`` int32 from 0; fractions are whole numbers up to the unit, which is at most a billion;
    the offset is below it."""
    whole = torch.tensor(fractions, dtype=torch.int32)
    share = torch.tensor([fraction / unit for fraction in fractions])
    high = amount // _BASE
    low = amount - high * _BASE
    first, remainder = divided(whole * high, unit, share * high.float())
    estimate = remainder.float() * (_BASE / unit) + share * low.float() + offset / unit
    second, _ = divided(remainder * _BASE + whole * low + offset, unit, estimate)
    floors = (first * _BASE + second).unbind()
    return [floor if fraction else 0 for floor, fraction in zip(floors, fractions, strict=True)]
