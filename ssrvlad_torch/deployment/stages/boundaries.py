"""Boundaries as ONNX operators."""

from __future__ import annotations

from ...stages.boundaries import directions
from ..graph import Graph, Symbol
from ..words import EACH_PIXEL, Words, inside, neighbourhood


def boundaries_in_graph(graph: Graph, words: Words) -> Words:
    """`boundaries` in a graph."""
    within = inside(graph, words.grid)
    nw, ne, sw, se = _diagonals(graph, words.with_line(within))
    seen = nw & ne & sw & se & within
    found = graph.like(words.line, 0, "int32")
    for bit, layers in enumerate(directions(*_diagonals(graph, words))):
        found = found | (_any_layer(layers & seen) << bit)
    return words.with_line(found)


def _diagonals(graph: Graph, words: Words) -> tuple[Symbol, Symbol, Symbol, Symbol]:
    _, (_, ne, _, se, _, sw, _, nw) = neighbourhood(graph, words)
    return nw, ne, sw, se


def _any_layer(line: Symbol) -> Symbol:
    """Bit 0 of each pixel that is in some layer."""
    for bits, mask in ((4, 0x0F), (2, 0x03), (1, 0x01)):
        line = (line | line >> bits) & mask * EACH_PIXEL
    return line
