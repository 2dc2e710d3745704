"""Double-float arithmetic: sums of two float32 with twice its precision, without float64.

The power normalisation enlarges errors of numbers that should be zero: 1e-7 becomes 5e-6. So the
products with the tables of the harmonics split both factors into slices of a few bits, of which all
products and sums are exact in float32.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .graph import Graph, Symbol

_BITS = 24
_BYTES = 3

Table = npt.NDArray[Any]


class DoubleFloat(NamedTuple):
    """``high + low``, both float32; ``low`` is less than the last digit of ``high``."""

    high: Symbol
    low: Symbol


def weighted_means(graph: Graph, whole: Symbol, weights: Table) -> DoubleFloat:
    """Products of whole numbers with a table of weights.

    Args:
        graph: the graph to add nodes to.
        whole: ``(B, R, n)`` float32, whole numbers from 0 to 2 ** 24.
        weights: ``(n, m)`` float64, not negative; columns sum to at most 1.

    Returns:
        ``(B, R, m)``.
    """
    high = graph.Floor(whole / 65536)
    middle = graph.Floor((whole - high * 65536) / 256)
    low = whole - high * 65536 - middle * 256
    bits = _BITS - 8 - int(np.count_nonzero(weights, axis=0).max(initial=1) - 1).bit_length()
    slices, units = _sliced(weights, [_BITS - 8, bits])
    rounded = sum(part * unit for part, unit in zip(slices, units, strict=True))
    slices, units = [*slices, (weights - rounded) / units[-1]], [*units, units[-1]]
    blocks = _blocks(graph, [high, middle, low], slices)
    terms = [
        blocks[byte][part] * (256.0 ** (2 - byte) * unit)
        for byte in range(_BYTES)
        for part, unit in enumerate(units)
    ]
    total = DoubleFloat(terms[0], graph.like(terms[0], 0, "float32"))
    for term in terms[1:]:
        total = _plus(total, term)
    return DoubleFloat(*_two_sum(total.high, total.low))


def root(graph: Graph, number: DoubleFloat) -> DoubleFloat:
    """The square root of numbers from 0 to 1."""
    estimate = graph.Sqrt(number.high)
    coarse = graph.Floor(estimate * 4096) / 4096
    fine = estimate - coarse
    remainder = number.high - coarse * coarse - coarse * fine * 2 - fine * fine + number.low
    return DoubleFloat(estimate, remainder / graph.Max(estimate * 2, 1e-30))


def product(graph: Graph, numbers: DoubleFloat, table: Table) -> Symbol:
    """``(B, R, m)`` float32, the product of ``(B, R, n)`` numbers from 0 to 1 with an ``(n, m)``
    float64 table; errors are about 1e-9 of the largest number."""
    coarse = graph.Floor(numbers.high * 512) / 512
    rest = numbers.high - coarse + numbers.low
    middle = graph.Floor(rest * 2**18) / 2**18
    scale = float(2.0 ** np.ceil(np.log2(np.abs(table).max())))
    bits = max(_BITS - 9 - int(len(table) - 1).bit_length(), 4)
    slices, units = _sliced(table / scale, [bits, bits])
    rounded = [part * unit for part, unit in zip(slices, units, strict=True)]
    slices = [*rounded, table / scale - sum(rounded)]
    blocks = _blocks(graph, [coarse, middle, rest - middle], slices)
    smallest_first = sorted(np.ndindex(3, 3), key=lambda place: (-sum(place), place))
    first, *others = (blocks[row][column] for row, column in smallest_first)
    for block in others:
        first = first + block
    return first * scale


def _sliced(table: Table, bits: list[int]) -> tuple[list[Table], list[float]]:
    """Slices of whole numbers of the given bits, and their units: the table is about the sum of
    slice times unit."""
    slices, units, unit = [], [], 1.0
    for count in bits:
        unit /= 2.0**count
        part = np.trunc(table / unit)
        slices.append(part)
        units.append(unit)
        table = table - part * unit
    return slices, units


def _blocks(graph: Graph, rows: list[Symbol], columns: list[Table]) -> list[list[Symbol]]:
    """The products of every ``(B, R, n)`` with every ``(n, m)``, by one matrix product."""
    table = graph.sparse_constant(np.concatenate(columns, 1).astype(np.float32))
    products = graph.MatMul(graph.Concat(*rows, axis=1), table)
    by_row = graph.split(products, len(rows), axis=1)
    return [graph.split(row, len(columns), axis=2) for row in by_row]


def _plus(pair: DoubleFloat, term: Symbol) -> DoubleFloat:
    total, error = _two_sum(pair.high, term)
    return DoubleFloat(total, pair.low + error)


def _two_sum(a: Symbol, b: Symbol) -> tuple[Symbol, Symbol]:
    """The rounded sum and its rounding error (Knuth)."""
    total = a + b
    part = total - a
    return total, a - (total - part) + (b - part)
