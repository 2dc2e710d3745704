"""Soft regions: holes that are filled and regions that are dropped, as the hard method has them.

Whether a region is too small is a matter of counting and has no gradient; what is dropped, and
what is filled, has none either.
"""

from __future__ import annotations

from torch import Tensor


def soft_regions(layers: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Layers with 1 where a hole was filled and 0 where a region was dropped.

    Args:
        layers: ``(B, 8, h, w)`` after `soft_open_and_close`.
        before, after: ``(B, 8, h, w)`` bool, the hard layers before the holes were filled and
            after the regions were dropped.

    Returns:
        ``(B, 8, h, w)``, 0 to 1.
    """
    return layers.masked_fill(after & ~before, 1.0).masked_fill(before & ~after, 0.0)
