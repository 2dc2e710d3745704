"""Keypoints as ONNX operators."""

from __future__ import annotations

from ...stages.bitplanes import steps_around, three_of_four, two_or_more
from ..graph import Graph
from ..words import Words, neighbourhood


def end_points_in_graph(graph: Graph, skeleton: Words) -> Words:
    """`end_points` in a graph."""
    pixels, ring = neighbourhood(graph, skeleton)
    return skeleton.with_line(pixels & ~two_or_more(ring))


def intersections_in_graph(graph: Graph, skeleton: Words) -> Words:
    """`intersections` in a graph."""
    pixels, ring = neighbourhood(graph, skeleton)
    crossing = pixels & three_of_four(steps_around(ring))
    north, north_east, *_, west, north_west = neighbourhood(graph, skeleton.with_line(crossing))[1]
    return skeleton.with_line(crossing & ~(west | north_west | north | north_east))
