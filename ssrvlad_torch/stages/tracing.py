"""What `torch.export` must record in another way, for runtimes other than torch."""

import math
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

MAX_WHOLE = 1 << 24
"""Whole numbers up to this one are exact in float32."""

MOST = 1 << 31
"""Largest number of entries in a list: without a limit, the exporter writes larger numbers than
int64 holds."""


def exporting() -> bool:
    """Whether `torch.export` records. `torch.compile` folds `torch.compiler.is_exporting`, but not
    the flag."""
    return torch.compiler._is_exporting_flag


def real(largest: float = math.inf) -> torch.dtype:
    """float64; float32 for whole numbers up to ``largest`` that are exact in it, and under export,
    where it is the only type in which every runtime computes."""
    single = exporting() or largest <= MAX_WHOLE
    return torch.float32 if single else torch.float64


def length(size: int) -> int:
    """A size of at least 1 that is computed from other sizes; under export a symbol of its own, for
    `torch.export` takes minutes over long formulas."""
    if isinstance(size, int):
        return size
    symbol = number_in(torch.full((), size))
    torch._check(symbol >= 1)
    return symbol


def number_in(tensor: Tensor) -> int:
    """The number in a ``()`` or ``(1,)`` tensor, 0 to 2 ** 31, as a size or an index."""
    symbol = cast(int, tensor.item())
    torch._check(symbol >= 0)
    torch._check(symbol <= MOST)
    return symbol


def looked_up(table: Tensor, index: Tensor) -> Tensor:
    """``table[index]`` of ``(T,)`` and ``(n,)``, by the faster operator: for a million entries ONNX
    Runtime takes 1 ms with gather and 12 with select, torch on a CPU 4 and 1."""
    if exporting():
        return torch.gather(table, 0, index)
    return table.index_select(0, index)


def repeat_while(
    going: Tensor, body: Callable[..., tuple[Tensor, ...]], *carried: Tensor
) -> tuple[Tensor, ...]:
    """``going, *carried = body(*carried)`` while ``going``, ``()`` bool, is true."""
    if exporting():
        from torch._higher_order_ops.while_loop import while_loop

        results: tuple[Tensor, ...] = while_loop(
            lambda going, *_: going.clone(), lambda _, *state: body(*state), (going, *carried)
        )
        return results[1:]
    while going:
        going, *state = body(*carried)
        carried = tuple(state)
    return carried


def sum_of_integers(numbers: Tensor) -> Tensor:
    """The sum over the last axis, modulo 2 ** 32 where int64 is cut: OpenVINO adds integers up in
    float32, but not in cumsum."""
    return numbers.cumsum(-1)[..., -1]


def divided(number: Tensor, divisor: Tensor | int, estimate: Tensor) -> tuple[Tensor, Tensor]:
    """Quotient, rounded down, and remainder of integers that are too large for a runtime: OpenVINO
    cuts int64 to 32 bits and divides integers in float32. The distance from the nearest multiple
    of the divisor is at most about half of it, so it is right in spite of the overflow.

    Args:
        number: ``(n,)`` integers, modulo 2 ** 32.
        divisor: above 0, below 2 ** 31.
        estimate: ``(n,)`` float, the quotient within 0.4.
    """
    nearest = estimate.round().to(number.dtype)
    remainder = number - nearest * divisor
    below = (remainder < 0).to(number.dtype)
    return nearest - below, remainder + below * divisor
