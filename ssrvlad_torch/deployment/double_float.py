"""Numbers of twice the digits of float32, as sums of two, for graphs without float64.

The power normalisation enlarges the errors of what should be zero: an error of 1e-7 becomes one of
5e-6. So the products with the tables of the harmonics are taken of slices of both factors, of so
few bits that all the products and sums are exact.
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
    """``high + low``, float32 both, ``low`` less than the last digit of ``high``."""

    high: Symbol
    low: Symbol


def weighted_means(graph: Graph, whole: Symbol, weights: Table) -> DoubleFloat:
    """Whole numbers times a table.

    Args:
        graph: where the nodes go.
        whole: ``(B, R, n)`` float32 from 0 up to 2 ** 24.
        weights: ``(n, m)`` float64, not negative, columns sum to 1 at most.

    Returns:
        ``(B, R, m)``.
    """
    high = graph.Floor(whole / 65536)
    middle = graph.Floor((whole - high * 65536) / 256)
    low = whole - high * 65536 - middle * 256
    bits = _BITS - 8 - int(np.count_nonzero(weights, axis=0).max(initial=1) - 1).bit_length()
    slices, units = _cut_down(weights, [_BITS - 8, bits])
    held = sum(part * unit for part, unit in zip(slices, units, strict=True))
    slices, units = [*slices, (weights - held) / units[-1]], [*units, units[-1]]
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
    """The square root of what is not negative, from 0 to 1."""
    near = graph.Sqrt(number.high)
    coarse = graph.Floor(near * 4096) / 4096
    fine = near - coarse
    left = number.high - coarse * coarse - coarse * fine * 2 - fine * fine + number.low
    return DoubleFloat(near, left / graph.Max(near * 2, 1e-30))


def product(graph: Graph, numbers: DoubleFloat, table: Table) -> Symbol:
    """``(B, R, n)`` numbers from 0 to 1 times an ``(n, m)`` float64 table; ``(B, R, m)`` float32,
    right to about 1e-9 of the largest."""
    coarse = graph.Floor(numbers.high * 512) / 512
    rest = numbers.high - coarse + numbers.low
    middle = graph.Floor(rest * 2**18) / 2**18
    scale = float(2.0 ** np.ceil(np.log2(np.abs(table).max())))
    bits = max(_BITS - 9 - int(len(table) - 1).bit_length(), 4)
    slices, units = _cut_down(table / scale, [bits, bits])
    rounded = [part * unit for part, unit in zip(slices, units, strict=True)]
    slices = [*rounded, table / scale - sum(rounded)]
    blocks = _blocks(graph, [coarse, middle, rest - middle], slices)
    smallest_first = sorted(np.ndindex(3, 3), key=lambda place: (-sum(place), place))
    first, *others = (blocks[row][column] for row, column in smallest_first)
    for block in others:
        first = first + block
    return first * scale


def _cut_down(table: Table, bits: list[int]) -> tuple[list[Table], list[float]]:
    """Whole numbers of so many bits each, and units, whose products sum to the table nearly."""
    slices, units, unit = [], [], 1.0
    for count in bits:
        unit /= 2.0**count
        part = np.trunc(table / unit)
        slices.append(part)
        units.append(unit)
        table = table - part * unit
    return slices, units


def _blocks(graph: Graph, rows: list[Symbol], columns: list[Table]) -> list[list[Symbol]]:
    """The products of every ``(B, R, n)`` with every ``(n, m)``, by one multiplication."""
    table = graph.sparse_constant(np.concatenate(columns, 1).astype(np.float32))
    found = graph.MatMul(graph.Concat(*rows, axis=1), table)
    return [graph.split(row, len(columns), axis=2) for row in graph.split(found, len(rows), axis=1)]


def _plus(pair: DoubleFloat, term: Symbol) -> DoubleFloat:
    total, error = _two_sum(pair.high, term)
    return DoubleFloat(total, pair.low + error)


def _two_sum(one: Symbol, other: Symbol) -> tuple[Symbol, Symbol]:
    """The rounded sum, and what rounding took (Knuth)."""
    total = one + other
    part = total - one
    return total, one - (total - part) + (other - part)
