"""Charts as inline SVG. Colours come from the page's style sheet, so a chart follows its theme."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import numpy.typing as npt

from ..outcomes import Floats

WIDTH, HEIGHT = 440, 300
LEFT, RIGHT, TOP, BOTTOM = 48, 14, 12, 42
_COLUMNS = 2 * WIDTH


@dataclass(frozen=True)
class Axis:
    """What an axis shows.

    Attributes:
        label: stands beside it.
        low, high: values at its ends, ``low < high``.
        ticks: values that are marked.
        logarithmic: whether equal steps are equal ratios; then ``low`` is above 0.
    """

    label: str
    low: float
    high: float
    ticks: tuple[float, ...]
    logarithmic: bool = False

    def share(self, values: npt.ArrayLike) -> Floats:
        """How far along the axis values lie, 0 at the low end and 1 at the high end."""
        scale = np.log if self.logarithmic else np.asarray
        low, high, place = (scale(np.asarray(v, float)) for v in (self.low, self.high, values))
        return np.asarray((place - low) / (high - low), np.float64)


@dataclass(frozen=True)
class Plane:
    """Two axes; places are pixels of the drawing, which is `WIDTH` by `HEIGHT`.

    Below 0, the ticks of y tell the size alone: a chart may be mirrored there.
    """

    x: Axis
    y: Axis

    def across(self, values: npt.ArrayLike) -> Floats:
        """Pixels from the left edge."""
        return LEFT + self.x.share(values) * (WIDTH - LEFT - RIGHT)

    def down(self, values: npt.ArrayLike) -> Floats:
        """Pixels from the upper edge."""
        return HEIGHT - BOTTOM - self.y.share(values) * (HEIGHT - TOP - BOTTOM)


def linear_axis(label: str, low: float, high: float, whole: bool = False) -> Axis:
    """An axis with about six round ticks; ends that all but coincide are moved apart.

    Args:
        whole: whether the ticks are whole numbers.
    """
    size = max(abs(low), abs(high), 1.0)
    if not high - low > 1e-9 * size:
        margin = 1e-3 * size
        low, high = low - margin, high + margin
    raw = max((high - low) / 7, 1.0 if whole else 0.0)
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * unit for factor in (1, 2, 5, 10) if factor * unit >= raw * 0.999)
    numbers = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return Axis(label, low, high, tuple(round(number * step, 12) for number in numbers))


def chart(name: str, plane: Plane, marks: Iterable[str], title: str, description: str) -> str:
    """An ``<svg>`` with axes and marks.

    Args:
        name: its id; the script finds it and its axes by this.
        marks: from the functions below, the first at the bottom.
        title, description: what a screen reader says.
    """
    ends = (plane.x.low, plane.x.high, plane.y.low, plane.y.high)
    return (
        f'<svg id="{name}" class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-labelledby="{name}-title {name}-text" data-ends="{" ".join(map(repr, ends))}" '
        f'data-frame="{LEFT} {WIDTH - RIGHT} {TOP} {HEIGHT - BOTTOM}">'
        f'<title id="{name}-title">{escape(title)}</title>'
        f'<desc id="{name}-text">{escape(description)}</desc>'
        f"{_grid(plane)}{''.join(marks)}</svg>"
    )


def line(plane: Plane, x: Floats, y: Floats, kind: str) -> str:
    """Straight lines through points with rising x; drawn exactly, see `thinned`."""
    x, y = thinned(plane.across(x), plane.down(y))
    return f'<polyline class="line {kind}" points="{_points(x, y)}"/>' if len(x) else ""


def band(plane: Plane, x: Floats, low: Floats, high: Floats, kind: str) -> str:
    """The area between two lines; nothing where an end is NaN."""
    meant = ~(np.isnan(low) | np.isnan(high))
    if not meant.any():
        return ""
    across = plane.across(x[meant])
    edge = _points(
        np.concatenate((across, across[::-1])),
        np.concatenate((plane.down(high[meant]), plane.down(low[meant])[::-1])),
    )
    return f'<polygon class="band {kind}" points="{edge}"/>'


def dot(plane: Plane, x: float, y: float, kind: str, label: str) -> str:
    """A point with a tool tip."""
    return (
        f'<circle class="dot {kind}" cx="{_number(plane.across(x))}" '
        f'cy="{_number(plane.down(y))}" r="5"><title>{escape(label)}</title></circle>'
    )


def bar(plane: Plane, edges: tuple[float, float], ends: tuple[float, float], kind: str) -> str:
    """A bar from one value of y to another."""
    left, right = plane.across(edges)
    lower, upper = plane.down(ends)
    return (
        f'<rect class="bar {kind}" x="{_number(left)}" y="{_number(min(lower, upper))}" '
        f'width="{_number(right - left)}" height="{_number(abs(lower - upper))}"/>'
    )


def upright(plane: Plane, x: float, kind: str, label: str) -> str:
    """A vertical line over the whole height, with a tool tip."""
    place = _number(plane.across(x))
    return (
        f'<line class="upright {kind}" x1="{place}" x2="{place}" y1="{TOP}" '
        f'y2="{HEIGHT - BOTTOM}"><title>{escape(label)}</title></line>'
    )


def thinned(x: Floats, y: Floats, columns: int = _COLUMNS) -> tuple[Floats, Floats]:
    """Fewer points that draw the same line: of each column of pixels the first, the last, the
    lowest and the highest (M4: Jugel et al., PVLDB 2014).

    Args:
        x, y: pixels, x rising.
        columns: in the drawing's whole width.
    """
    if len(x) == 0:
        return x, y
    column = np.floor(x * columns / WIDTH).astype(np.int64)
    first = np.flatnonzero(np.diff(column, prepend=column[0] - 1))
    kept = set()
    for start, end in zip(first, [*first[1:], len(x)], strict=True):
        kept |= {start, end - 1, start + y[start:end].argmin(), start + y[start:end].argmax()}
    rows = sorted(kept)
    return x[rows], y[rows]


def _grid(plane: Plane) -> str:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    marks = []
    for tick, place in zip(plane.x.ticks, map(_number, plane.across(plane.x.ticks)), strict=True):
        marks.append(f'<line class="grid" x1="{place}" x2="{place}" y1="{TOP}" y2="{bottom}"/>')
        marks.append(f'<text x="{place}" y="{bottom + 16}" text-anchor="middle">{tick:g}</text>')
    for tick, place in zip(plane.y.ticks, map(_number, plane.down(plane.y.ticks)), strict=True):
        marks.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{place}" y2="{place}"/>')
        marks.append(
            f'<text x="{LEFT - 6}" y="{place}" dy="0.35em" text-anchor="end">{abs(tick):g}</text>'
        )
    middle_x, middle_y = (LEFT + right) / 2, (TOP + bottom) / 2
    marks.append(
        f'<text class="label" x="{middle_x}" y="{HEIGHT - 6}" text-anchor="middle">'
        f"{escape(plane.x.label)}</text>"
        f'<text class="label" transform="translate(12 {middle_y}) rotate(-90)" '
        f'text-anchor="middle">{escape(plane.y.label)}</text>'
    )
    return f'<g aria-hidden="true">{"".join(marks)}</g>'


def _points(x: Floats, y: Floats) -> str:
    return " ".join(f"{_number(a)},{_number(b)}" for a, b in zip(x, y, strict=True))


def _number(value: float | Floats) -> str:
    """Hundredths of a pixel, without zeros that say nothing."""
    return f"{float(value):.2f}".rstrip("0").rstrip(".")


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """A list of the kinds of marks and what they stand for."""
    items = (f'<li><i class="key {kind}"></i>{escape(text)}</li>' for kind, text in entries)
    return f'<ul class="legend">{"".join(items)}</ul>'
