"""Bit-planes in a graph: the layers of a batch as one line of words.

In ONNX Runtime a bitwise operation takes as long on a byte as on a word, so a word holds three
pixels of a row times eight layers: bit ``8 * p + k`` is layer ``k`` of pixel ``p``. Each row ends
with at least one background pixel and each image with a background row. So the neighbours of a word
are the words one pitch before and after it on the line, and no region continues across an edge.
`bitplanes` does the same for tensors, with a byte for each pixel.

Words, lists and sizes are int32, because some runtimes cut int64 to 32 bits silently. A word has 24
bits and is never negative; bits are shifted by products and quotients. These are exact in float32,
in which some runtimes divide and compare int32.

A pixel's place is its index on the line, with margins: ``3 * word + p``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..stages.bitplanes import LAYERS, line_neighbours
from .graph import Graph, Symbol

PIXELS = 3
"""Pixels in a word."""

EACH_PIXEL = 0x010101
"""Layer 0 of all pixels of a word."""

ALL = 0xFF * EACH_PIXEL
"""All layers of all pixels of a word."""

_LAST = 8 * (PIXELS - 1)

Ring = tuple[Symbol, ...]
"""The neighbours N, NE, E, SE, S, SW, W, NW of every pixel, as words."""


class Grid(NamedTuple):
    """Size of a batch, ``()`` int32 symbols: images, rows, columns, words of a row on the line."""

    images: Symbol
    height: Symbol
    width: Symbol
    pitch: Symbol

    @property
    def words(self) -> Symbol:
        """Length of the line in words."""
        return self.images * (self.height + 1) * self.pitch

    def image(self, place: Symbol) -> Symbol:
        """The image of a pixel."""
        return place // ((self.height + 1) * self.pitch * PIXELS)

    def row(self, place: Symbol) -> Symbol:
        """Row of a pixel in its image."""
        return place // (self.pitch * PIXELS) % (self.height + 1)

    def column(self, place: Symbol) -> Symbol:
        """Column of a pixel in its image."""
        return place % (self.pitch * PIXELS)


class Words(NamedTuple):
    """The layers of a batch: ``line`` is ``(grid.words,)`` int32."""

    line: Symbol
    grid: Grid

    def with_line(self, line: Symbol) -> Words:
        """Layers with another line and the same size."""
        return self._replace(line=line)


class Pixels(NamedTuple):
    """Pixels of the layers, sorted by layer, then by place; ``(n,)`` int32 each."""

    layer: Symbol
    place: Symbol


class GraphPoints(NamedTuple):
    """`bitplanes.Points` in a graph: group ``k * B + b``, row and column, ``(n,)`` int32 each."""

    group: Symbol
    y: Symbol
    x: Symbol


class Runs(NamedTuple):
    """Maximal horizontal runs of the layers, sorted by layer, then by place; ``(n,)`` int32 each.

    ``first`` and ``last`` are the places of the first and the last pixel of a run.
    """

    layer: Symbol
    first: Symbol
    last: Symbol

    @property
    def length(self) -> Symbol:
        """Number of pixels of each run."""
        return self.last - self.first + 1

    def where(self, chosen: Symbol) -> Runs:
        """The runs for which ``(n,)`` bool is true."""
        index = chosen.graph.indices(chosen)
        return Runs(*(column.take(index) for column in self))


def grid_of(images: Symbol, height: Symbol, width: Symbol) -> Grid:
    """The grid of ``images`` images of ``height`` rows and ``width`` columns."""
    return Grid(images, height, width, width // PIXELS + 1)


def inside(graph: Graph, grid: Grid) -> Symbol:
    """``(grid.words,)`` int32, all bits set in all pixels outside the margins."""
    masks = np.array([(1 << 8 * p) - 1 for p in range(PIXELS + 1)], np.int32)
    left = grid.width - graph.arange(grid.pitch) * PIXELS
    row = graph.constant(masks).take(graph.Min(left, PIXELS)).reshape(1, -1)
    image = graph.Pad(graph.Expand(row, graph.vector(grid.height, 1)), [0, 0, 1, 0])
    return graph.Tile(image.reshape(-1), graph.vector(grid.images))


def neighbourhood(graph: Graph, words: Words) -> tuple[Symbol, Ring]:
    """The words of a line and the eight neighbours of their pixels."""
    length, pitch = words.grid.words, words.grid.pitch
    padded = graph.Pad(words.line, graph.vector(pitch + 1, pitch + 1))
    return line_neighbours(padded, pitch, length, shifted)


def west_of(graph: Graph, line: Symbol) -> Symbol:
    """The west neighbours of all pixels."""
    return up(line, 8) + graph.Pad(line[:-1] >> _LAST, [1, 0])


def east_of(graph: Graph, line: Symbol) -> Symbol:
    """The east neighbours of all pixels."""
    return (line >> 8) + graph.Pad(up(line[1:], _LAST), [0, 1])


def shifted(before: Symbol, here: Symbol, after: Symbol) -> tuple[Symbol, Symbol]:
    """The west and the east neighbours of the pixels of words, from the words before and after."""
    return up(here, 8) + (before >> _LAST), (here >> 8) + up(after, _LAST)


def up(line: Symbol, bits: Symbol | int) -> Symbol:
    """Words with their bits shifted up; bits that leave the word are lost."""
    return line << bits & ALL


def pixels_of(graph: Graph, line: Symbol) -> Pixels:
    """The pixels of every layer. Empty words are skipped first, then empty pixels."""
    word = graph.indices(line)
    pixels = _bytes(graph, line.take(word)).reshape(-1)
    entry = graph.indices(pixels)
    place = word.take(entry // PIXELS) * PIXELS + entry % PIXELS
    bits = graph.constant((1 << np.arange(LAYERS)).astype(np.uint8)[:, None])
    layer, entry = graph.split(graph.NonZero(pixels.take(entry) & bits).to("int32"), 2, axis=0)
    return Pixels(layer.reshape(-1), place.take(entry.reshape(-1)))


def runs_of(graph: Graph, line: Symbol) -> Runs:
    """The runs of every layer. Runs of a layer do not overlap: the n-th first pixel belongs to the
    n-th last one."""
    first = pixels_of(graph, first_of_runs(graph, line))
    last = pixels_of(graph, line & ~east_of(graph, line))
    return Runs(first.layer, first.place, last.place)


def first_of_runs(graph: Graph, line: Symbol) -> Symbol:
    """Pixels whose west neighbour is background."""
    return line & ~west_of(graph, line)


def paint_in_graph(graph: Graph, runs: Runs, grid: Grid) -> Symbol:
    """The line of the given runs; each run sets its bits in every word that it reaches."""
    spans = np.zeros((PIXELS, PIXELS), np.int32)
    for first, last in np.ndindex(spans.shape):
        spans[first, last] = sum(1 << 8 * p for p in range(first, last + 1))
    begin, end = runs.first // PIXELS, runs.last // PIXELS
    run, step = graph.repeated(end - begin + 1)
    word = begin.take(run) + step
    first = graph.Max(runs.first.take(run) - word * PIXELS, 0)
    last = graph.Min(runs.last.take(run) - word * PIXELS, PIXELS - 1)
    span = graph.constant(spans.ravel()).take(first * PIXELS + last)
    bits = span << runs.layer.take(run)
    return graph.sums(word, bits, grid.words)


def points_of(graph: Graph, words: Words) -> GraphPoints:
    """The pixels of every layer, in the order of `bitplanes.points`."""
    pixels, grid = pixels_of(graph, words.line), words.grid
    group = pixels.layer * grid.images + grid.image(pixels.place)
    return GraphPoints(group, grid.row(pixels.place), grid.column(pixels.place))


def count_points_in_graph(graph: Graph, points: GraphPoints, images: Symbol) -> Symbol:
    """``(B, 8)`` int32, the number of points of each layer of each image."""
    counts = graph.counts(points.group, images * LAYERS).reshape(-1, 1)
    return by_image_in_graph(graph, counts, images).reshape(images, LAYERS)


def by_image_in_graph(graph: Graph, values: Symbol, images: Symbol) -> Symbol:
    """``(8 * B, n)`` values by group -> ``(B, 8, n)``."""
    by_layer = values.reshape(LAYERS, images, -1)
    return graph.Transpose(by_layer, perm=[1, 0, 2])


def _bytes(graph: Graph, line: Symbol) -> Symbol:
    """``(n, 3)`` uint8, the pixels of each word."""
    return (line.reshape(-1, 1) >> 8 * np.arange(PIXELS) & 255).to("uint8")
