"""The intermediate results of the method, and their picture (extra ``eval``)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..config import AREA_LAYERS, SSRVLADConfig
from ..files import drawn_text, new_figure, png_address
from ..taxonomy import CATEGORIES, NO_LAYER, LabelSpace, colourise
from .bitplanes import unpack
from .boundaries import DIRECTIONS, boundaries
from .centroid import centre_table, centroids
from .harmonics import HarmonicHistograms
from .keypoints import end_points, intersections
from .layers import merge
from .residuals import ResidualHistograms, masks_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH, _ROW = 10.0, 3.6
_ARC_STEPS = 10
_COLOURS: tuple[str, ...] = (
    *("#b58bb5", "#f5a3ee", "#a9a9a9", "#e3c770"),
    *("#a9c97b", "#9cc4e4", "#cdbccd", "#fac8be"),
)
_BOUNDARY = "#555555"
_TARGET = 0.8
_HARMONICS = """Below each: its histogram. Rings are distances from the
vanishing column, sectors directions; dark is where much
of it lies. Guard rail counts as building, parking as ground."""
_RESIDUALS = """Below each: its histogram. Rings are distances, sectors
directions; red is where the keypoints see more skeleton
than the centre does, blue where they see less (Eq. 2)."""


@dataclass(frozen=True, repr=False)
class Explanation:
    """Every step from label maps to descriptors, for B images on a grid of ``h x w`` pixels.

    A notebook shows it as the picture of `show`. Masks are ``(B, 8, h, w)`` bool.

    Attributes:
        labels: ``(B, H, W)`` ids, the label maps; for class scores, the best class.
        label_space: what the ids mean.
        layers: masks of the categories after the reduction to the grid.
        clean_layers: masks after morphology, hole filling and small-region removal.
        skeleton: masks of the clean layers' skeletons.
        end_points, intersections: masks of the keypoints of the skeletons.
        centres: ``(B, 8, 2)`` int64, row and column of each layer's centre (Eq. 1), -1 for a layer
            without pixels.
        histograms: of the aggregation: `ResidualHistograms` or `HarmonicHistograms`.
        descriptor: ``(B, D)`` float32, see `SSRVLAD`.
    """

    labels: Tensor
    label_space: LabelSpace
    layers: Tensor
    clean_layers: Tensor
    skeleton: Tensor
    end_points: Tensor
    intersections: Tensor
    centres: Tensor
    histograms: ResidualHistograms | HarmonicHistograms
    descriptor: Tensor

    @property
    def keypoints(self) -> Tensor:
        """``(B, 8, h, w)`` bool, end points and intersections."""
        return self.end_points | self.intersections

    @property
    def empty(self) -> Tensor:
        """``(B,)`` bool, true where the descriptor is zero: such an image matches nothing."""
        return ~self.descriptor.any(dim=1)

    def show(
        self,
        image: int = 0,
        title: str = "",
        picture: npt.NDArray[np.uint8] | None = None,
        features: npt.NDArray[np.uint8] | None = None,
    ) -> Figure:
        """One image of the batch as a matplotlib figure.

        At the top is the label map with its classes. Below are, each above its histogram, the clean
        layers with skeleton, keypoints and centre for the residuals of ``paper``, or the layers and
        boundaries with the vanishing column for the harmonics of ``default``.

        Args:
            image: its number in the batch.
            title: of the label map.
            picture: ``(H, W, 3)`` uint8 of which it is the label map, to be drawn beside it.
            features: ``(columns, rows, bytes)`` uint8 of the picture; on it cells are then bright
                in which the network sees what it does not see elsewhere in the picture.

        Raises:
            ImportError: matplotlib is not installed (extra ``eval``).
            IndexError: the batch has no such image.
        """
        if not 0 <= image < len(self.labels):
            raise IndexError(f"expected an image from 0 to {len(self.labels) - 1}, got {image}")
        harmonic = isinstance(self.histograms, HarmonicHistograms)
        cells = _cells(self, image)
        columns = len(cells) // 2
        shown = 2 if picture is None else 3
        tall = self.layers.shape[2] / self.layers.shape[3]
        row = _WIDTH * shown / 2 / columns * (tall + _TARGET) + 0.6
        figure = new_figure(_WIDTH * shown / 2, _ROW + 2 * row)
        strips: Any = figure.subfigures(3, 1, height_ratios=(_ROW, row, row))
        *photograph, left, right = strips[0].subplots(1, shown)
        for axes in photograph:
            axes.imshow(picture)
            axes.set_title("the picture", size=11)
            axes.set_axis_off()
            if features is not None:
                _draw_features(axes, features)
        labels = self.labels[image].cpu().numpy()
        left.imshow(colourise(labels, self.label_space), interpolation="nearest")
        size = f"{labels.shape[1]} x {labels.shape[0]} pixels, {self.label_space.name}"
        lines = map(drawn_text, (title, size) if title else (size,))
        left.set_title("\n".join(lines), size=11)
        left.set_axis_off()
        _draw_legend(right, self, image, harmonic)
        for strip, drawn in zip(strips[1:], (cells[:columns], cells[columns:]), strict=True):
            grid = strip.add_gridspec(2, columns, height_ratios=(tall, _TARGET))
            for number, cell in enumerate(drawn):
                _draw_layer(strip.add_subplot(grid[0, number]), self, image, cell)
                _draw_histogram(strip.add_subplot(grid[1, number], polar=True), cell, harmonic)
        return figure

    def __repr__(self) -> str:
        images, (height, width) = len(self.labels), self.layers.shape[2:]
        grid = f"{width} x {height}"
        return f"Explanation({images} image{'s'[: images > 1]} of {self.label_space.name}, {grid})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the picture of the first image."""
        try:
            figure = self.show()
        except ImportError as error:
            return escape(f"{self!r}. {error}")
        address = png_address(partial(figure.savefig, dpi=80, format="png"))
        count = len(self.labels) - 1
        more = f"<p>{count} more: <code>.show(image=1)</code></p>" if count else ""
        return f'<img alt="{escape(repr(self))}" src="{address}">{more}'


def explain(
    labels: Tensor,
    label_space: LabelSpace,
    layers: Tensor,
    config: SSRVLADConfig,
    histograms: ResidualHistograms | HarmonicHistograms,
    descriptor: Tensor,
) -> Explanation:
    """See `SSRVLAD.explain`; ``layers`` ``(B, h, w)`` uint8 are those of the label maps."""
    planes, clean, skeleton = masks_of(layers, config)
    return Explanation(
        labels=labels,
        label_space=label_space,
        layers=unpack(planes),
        clean_layers=unpack(clean),
        skeleton=unpack(skeleton),
        end_points=unpack(end_points(skeleton)),
        intersections=unpack(intersections(skeleton)),
        centres=centre_table(centroids(clean), len(clean)),
        histograms=histograms,
        descriptor=descriptor,
    )


class _Cell(NamedTuple):
    """The name of a layer or of a boundary direction, its mask ``(h, w)`` bool, the colour of the
    mask, and its histogram ``(N, M)``."""

    name: str
    mask: npt.NDArray[np.bool_]
    colour: str
    histogram: npt.NDArray[Any]


def _cells(view: Explanation, image: int) -> list[_Cell]:
    """The clean layers with their residuals, the numerators of Eq. 2; or six layers and the
    boundaries in four directions with their soft histograms."""
    histograms, colours = view.histograms, _COLOURS
    names: tuple[str, ...] = CATEGORIES
    if not isinstance(histograms, HarmonicHistograms):
        masks = view.clean_layers[image]
        shown = (histograms.points - histograms.counts[..., None, None] * histograms.centre)[image]
    else:
        masks, shown = view.layers[image], histograms.bins[image]
        layer = masks.to(torch.uint8).argmax(0).masked_fill(~masks.any(0), NO_LAYER)
        numbers = merge(layer[None])
        areas = [numbers[0] == number for number in range(AREA_LAYERS)]
        masks = torch.stack([*areas, *boundaries(numbers)[0].bool()])
        names = (*CATEGORIES[:AREA_LAYERS], *(f"{name} boundaries" for name in DIRECTIONS))
        colours = (*_COLOURS[:AREA_LAYERS], *[_BOUNDARY] * len(DIRECTIONS))
    columns = names, masks.cpu().numpy(), colours, shown.cpu().numpy()
    return [_Cell(*cell) for cell in zip(*columns, strict=True)]


def _draw_legend(axes: Axes, view: Explanation, image: int, harmonic: bool) -> None:
    """Draws the classes of the label map with their colours, and explains the marks below."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ids = set(np.unique(view.labels[image].cpu().numpy()).tolist())
    classes = [
        Patch(
            color="#{:02x}{:02x}{:02x}".format(*(label.colour or (0, 0, 0))),
            # matplotlib leaves out a label that begins with _
            label=drawn_text(f" {label.name}" if label.name.startswith("_") else label.name),
        )
        for label in view.label_space.classes
        if label.id in ids
    ]
    dot: dict[str, Any] = {"ls": "", "mec": "black", "mew": 0.5}
    marks = [
        Line2D([], [], color="black", lw=1.5, label="skeleton"),
        Line2D([], [], marker="o", mfc="tab:red", ms=6, label="end point", **dot),
        Line2D([], [], marker="s", mfc="tab:blue", ms=6, label="intersection", **dot),
        Line2D([], [], marker="*", mfc="gold", ms=13, label="centre (Eq. 1)", **dot),
    ]
    if harmonic:
        marks = [Line2D([], [], color="tab:red", ls="--", label="vanishing column")]
    style: dict[str, Any] = {"frameon": False, "fontsize": 10}
    above = axes.legend(handles=classes, loc="upper left", ncols=3, handlelength=1, **style)
    axes.add_artist(above)
    axes.legend(handles=marks, loc="center left", ncols=2, bbox_to_anchor=(0, 0.34), **style)
    text = _HARMONICS if harmonic else _RESIDUALS
    axes.text(0, 0, text, transform=axes.transAxes, fontsize=10, va="bottom")
    axes.set_axis_off()


def _draw_features(axes: Axes, features: npt.NDArray[np.uint8]) -> None:
    """Darkens the cells of a picture that are like its other cells."""
    signs = 2.0 * np.unpackbits(features, axis=-1) - 1
    alike = signs @ signs.mean((0, 1)) / signs.shape[-1]
    shade = np.zeros((*alike.T.shape, 4))
    shade[..., 3] = 0.65 * (alike.T - alike.min()) / max(1e-9, np.ptp(alike))
    left, right, bottom, top = *axes.get_xlim(), *axes.get_ylim()
    axes.imshow(shade, extent=(left, right, bottom, top), interpolation="nearest")
    axes.set_title("the picture; bright: what features see only there", size=11)


def _draw_layer(axes: Axes, view: Explanation, image: int, cell: _Cell) -> None:
    from matplotlib.colors import ListedColormap

    colours = ListedColormap(["white", cell.colour])
    axes.imshow(cell.mask, cmap=colours, vmin=0, vmax=1, interpolation="nearest")
    axes.set_title(cell.name if cell.mask.any() else f"{cell.name}: none", size=11)
    axes.set(xticks=[], yticks=[])
    if isinstance(view.histograms, HarmonicHistograms):
        middle = (cell.mask.shape[1] - 1) / 2
        axes.axvline(middle + int(view.histograms.column[image]), color="tab:red", ls="--")
        return
    k = CATEGORIES.index(cell.name)
    masks = (view.skeleton, view.end_points, view.intersections)
    skeleton, ends, crossings = (mask[image, k].cpu().numpy().nonzero()[::-1] for mask in masks)
    axes.plot(*skeleton, ",", color="black")
    axes.plot(*ends, "o", mfc="tab:red", mec="black", mew=0.4, ms=4)
    axes.plot(*crossings, "s", mfc="tab:blue", mec="black", mew=0.4, ms=4)
    y, x = view.centres[image, k].tolist()
    if y >= 0:
        axes.plot(x, y, "*", mfc="gold", mec="black", mew=0.6, ms=12)


def _draw_histogram(axes: Axes, cell: _Cell, harmonic: bool) -> None:
    rings, sectors = cell.histogram.shape
    angles = np.linspace(0, 2 * np.pi, sectors * _ARC_STEPS + 1)
    arcs = cell.histogram.repeat(_ARC_STEPS, axis=1)
    most = max(1e-9, np.abs(cell.histogram).max())
    colours, least = ("Greys", 0) if harmonic else ("RdBu_r", -most)
    axes.pcolormesh(angles, np.arange(rings + 1), arcs, cmap=colours, vmin=least, vmax=most)
    axes.set_theta_direction(-1)  # type: ignore[attr-defined]
    turned = np.pi / sectors if harmonic else 0  # a soft sector is centred on its angle
    axes.set_theta_offset(turned)  # type: ignore[attr-defined]
    axes.set_xticks(angles[:-1:_ARC_STEPS], [])
    axes.set_yticks(np.arange(1, rings + 1), ["near", *[""] * (rings - 2), "far"][-rings:], size=6)
    axes.set_rlabel_position(45)  # type: ignore[attr-defined]
    for quarter, name in enumerate(("right", "up", "left", "down")):
        angle = turned - quarter * np.pi / 2
        axes.text(angle, 1.18 * rings, name, size=7, ha="center", va="center")
    axes.grid(lw=0.3, color="gray")
