"""Harmonics: soft shape contexts of areas and boundaries, as coefficients of smooth functions.

Not in the paper. The paper's N log-spaced rings and M sectors lie around one point, the anchor, and
their bins are soft: a cell counts in the two nearest rings and the two nearest sectors. A small
shift then changes the histogram only a little.

It is one of the two aggregations: layers -> histograms -> descriptor. `residuals` is the other."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import AREA_LAYERS, FAINT, SSRVLADConfig
from .boundaries import WIDTH, boundaries
from .grid_pooling import CELLS, ROWS, pool
from .layers import merge
from .tracing import MAX_WHOLE, exporting
from .vanishing_column import MAX_WIDTH, vanishing_columns

_SAMPLES = 4
"""Points on each side of a cell at which the bins are evaluated."""


class HarmonicHistograms(NamedTuple):
    """The soft histograms around the anchor.

    Attributes:
        bins: ``(B, 10, N, M)`` float64, 0 or more: the areas of six layers, then the lengths of
            the boundaries in four directions.
        column: ``(B,)`` int64, columns of the working grid from the middle of the image to the
            anchor, negative to the left.
    """

    bins: Tensor
    column: Tensor


class Harmonics(nn.Module):
    """The aggregation of the preset ``default``.

    Its tables are float64 buffers. They are stored as int64 words of the same bits, so that
    ``half()`` does not round them. Under export they are float32 constants."""

    def __init__(self, config: SSRVLADConfig) -> None:
        super().__init__()
        self.config = config
        most = max(config.harmonics, config.boundary_harmonics)
        rings, sectors = config.rings, config.sectors
        tables = {
            "bins": bin_table(CELLS, rings, sectors, config.radius, config.inner_radius),
            "basis": basis_table(rings, sectors, most, config.spectral_weight),
        }
        self._narrow = {name: table.float() for name, table in tables.items()}
        for name, table in tables.items():
            self.register_buffer(name, table.view(torch.int64), persistent=False)

    def histograms(self, layers: Tensor, shift: int = 0) -> HarmonicHistograms:
        """The soft histograms of areas and boundaries around the anchor, moved right by ``shift``
        columns, of ``(B, h, w)`` uint8, the layer of each pixel, 0 to 7 or `NO_LAYER`. A bin is the
        root of the mean of its cells (Hellinger), so that large layers do not dominate small ones.
        """
        config, (_, height, width) = self.config, layers.shape
        numbers = merge(layers)
        column = torch.zeros_like(numbers[:, 0, 0])
        if config.anchor == "vanishing-column":
            column = vanishing_columns(numbers)
        column = column + shift

        areas = numbers[:, None] == torch.arange(AREA_LAYERS, device=layers.device).view(-1, 1, 1)
        shares = pool(torch.cat((areas, boundaries(numbers)), 1), column)
        side = torch.sym_min(height, width) / ROWS / WIDTH  # lengths are in sides of a cell
        cells = torch.cat((shares[:, :AREA_LAYERS], shares[:, AREA_LAYERS:] * side), 1)
        bins = (cells.flatten(2) @ self.table("bins").T).sqrt()
        if exporting():  # a graph cannot raise an error
            sizes = torch.stack([torch.full((), size) for size in (width, height * width)])
            is_exact = (sizes <= torch.tensor([MAX_WIDTH, MAX_WHOLE])).all()
            bins = torch.where(is_exact, bins, torch.nan)
        return HarmonicHistograms(bins.unflatten(2, (config.rings, config.sectors)), column)

    def descriptor(self, histograms: HarmonicHistograms) -> Tensor:
        """The coefficients of each image's histograms in the basis, ``(B, 6 * harmonics + 4 *
        boundary_harmonics)`` float32 of length 1; exact zeros for an image without layers."""
        bins, config, basis = histograms.bins.flatten(2), self.config, self.table("basis")
        mean = bins.mean(-1, keepdim=True)  # a part of the first coefficient alone
        products = (bins - mean) @ basis.T + mean * basis.double().sum(1).to(basis)
        area = products[:, :AREA_LAYERS, : config.harmonics].flatten(1)
        length = products[:, AREA_LAYERS:, : config.boundary_harmonics].flatten(1)
        vector = torch.cat((area, length), 1)
        # to a power of the absolute value, up to a factor; a straight line far below FAINT
        vector = vector * ((vector * (1 / FAINT)).square() + 1) ** ((config.power - 1) / 2)
        norm = (vector * vector).sum(1, keepdim=True).sqrt()  # converters fail at F.normalize
        return (vector / norm.clamp(min=1e-12)).float()

    def sweep(self, layers: Tensor, columns: Sequence[int]) -> Tensor:
        """``(B, S, D)``, the descriptors around each of S anchors, see `histograms`."""
        return torch.stack([self.descriptor(self.histograms(layers, c)) for c in columns], dim=1)

    def table(self, name: str) -> Tensor:
        """``bins``, see `bin_table`, or ``basis``, see `basis_table`; in a graph in float32."""
        table = self.get_buffer(name)
        if exporting():
            return self._narrow[name].to(table.device)
        return table.view(torch.float64)


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # so that training can use it too
def bin_table(
    cells: tuple[int, int], rings: int, sectors: int, radius: float, inner_radius: float
) -> Tensor:
    """The matrix that takes the mean of the cells of each bin.

    Ring ``n`` is centred on ``radius * inner_radius ** (1 - n / (N - 1))`` of the
    diagonal, sector ``m`` on the angle ``2 pi m / M`` from +x towards +y. A cell between two
    centres counts in both, linearly in the logarithm of the distance and in the angle. A cell
    inside the first centre counts in the first ring; beyond ``radius`` it does not count.

    Returns:
        ``(N * M, rows * columns)`` float64; a row sums to 1, or to 0 for a bin without cells.
    """
    y, x = ((torch.arange(n * _SAMPLES).double() + 0.5) / _SAMPLES - n / 2 for n in cells)
    distance = torch.hypot(y[:, None], x[None]) / math.hypot(*cells)
    turn = torch.atan2(y[:, None], x[None]) / (2 * math.pi)
    steps = torch.log(distance / radius) / math.log(1 / inner_radius) if inner_radius < 1 else -1
    ring = torch.as_tensor((rings - 1) * (1 + steps)).expand_as(distance).clamp(0, rings - 1)
    from_ring, from_sector = (
        (position - torch.arange(count).double().view(-1, 1, 1)).abs()
        for position, count in ((ring, rings), (turn % 1 * sectors, sectors))
    )
    # 1 at the centre of a bin, falling to 0 at the next; sectors go around
    of_sector = (1 - from_sector).clamp(min=0) + (1 - (sectors - from_sector)).clamp(min=0)
    weight = (1 - from_ring).clamp(min=0)[:, None] * of_sector[None]
    weight = (weight * (distance <= radius)).flatten(0, 1)
    samples = weight.unflatten(2, (cells[1], _SAMPLES)).unflatten(1, (cells[0], _SAMPLES))
    return F.normalize(samples.sum((2, 4)).flatten(1), p=1, dim=1)


@lru_cache(maxsize=8)
@torch.inference_mode(False)
def basis_table(rings: int, sectors: int, harmonics: int, spectral_weight: float) -> Tensor:
    """The smoothest functions over the bins: a cosine over the rings times a wave over the sectors.

    A function that changes ``u / 2`` times over the rings and ``v`` times around has frequency
    ``f ** 2 = u ** 2 + v ** 2``. They are sorted by ``f``, then ``u``, then ``v``, the cosine
    before the sine, and each has the length ``(1 + f ** 2) ** (spectral_weight / 2)``: coarse
    functions, which all streets share, weigh less than fine ones.

    Returns:
        ``(harmonics, N * M)`` float64.
    """
    ring = torch.arange(rings).double()[:, None] + 0.5
    turn = torch.arange(sectors).double()[None] * (2 * math.pi / sectors)
    functions = []
    for u, v, phase in waves(rings, sectors)[:harmonics]:
        wave = torch.cos(math.pi * u * ring / rings) * torch.cos(v * turn - phase)
        length = (1 + u * u + v * v) ** (spectral_weight / 2)
        functions.append(wave.flatten() / wave.norm() * length)
    return torch.stack(functions)


def waves(rings: int, sectors: int) -> list[tuple[int, int, float]]:
    """Frequencies ``u`` and ``v``, and phase, of every basis function, in their order."""
    around = [(v, phase) for v in range((sectors + 1) // 2) for phase in (0.0, math.pi / 2)]
    frequencies = [(u, v, phase) for u in range(rings) for v, phase in around[:1] + around[2:]]
    return sorted(frequencies, key=lambda wave: (wave[0] ** 2 + wave[1] ** 2, *wave))
