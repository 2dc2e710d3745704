"""Soft regions: fills the holes that the hard method fills, and drops the regions that it drops.

The decision counts pixels and has no gradient; filled and dropped pixels have none either.
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
