"""Morphology as ONNX operators."""

from __future__ import annotations

from ..graph import Graph, Symbol
from ..words import Words, east_of, inside, west_of


def open_and_close_in_graph(
    graph: Graph, words: Words, opening: Symbol | int, closing: Symbol | int
) -> Words:
    """`open_and_close` in a graph; a radius that is 0 on every grid is the integer 0."""
    within = inside(graph, words.grid)

    def dilated(line: Symbol, radius: Symbol | int) -> Symbol:
        def by_one_pixel(_: Symbol, line: Symbol) -> list[Symbol]:
            beside = line | west_of(graph, line) | east_of(graph, line)
            pitch = words.grid.pitch
            above = graph.Pad(beside[: pitch * -1], graph.vector(pitch, 0))
            below = graph.Pad(beside[pitch:], graph.vector(0, pitch))
            return [(beside | above | below) & within]

        return line if radius == 0 else graph.repeat(radius, by_one_pixel, line)[0]

    opened = dilated(within - dilated(within - words.line, opening), opening)
    return words.with_line(within - dilated(within - dilated(opened, closing), closing))
