"""What differs where `torch.export` records a stage for other runtimes."""

from __future__ import annotations

import math
from typing import Any, cast

import torch

MAX_WHOLE = 1 << 24
"""Whole numbers up to this one are exact in float32."""


def is_exporting() -> bool:
    """Whether `torch.export` or ``torch.onnx.export(dynamo=True)`` is recording."""
    return torch.compiler.is_exporting()


def real(largest: float = math.inf) -> torch.dtype:
    """float64; float32 for whole numbers up to ``largest`` that are exact in it, and under export,
    where it is the only type in which every runtime computes."""
    return torch.float32 if is_exporting() or largest <= MAX_WHOLE else torch.float64


def length(size: int) -> int:
    """A size of at least 1 that is computed from other sizes; under export a symbol of its own, for
    `torch.export` takes minutes over long formulas."""
    if isinstance(size, int):
        return size
    symbol: Any = torch.full((), size).item()
    torch._check(symbol >= 1)
    return cast(int, symbol)
