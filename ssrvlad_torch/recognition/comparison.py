"""Comparison: the queries of one sequence against all rows of a map, by one channel.

The native core compares; where it is not built, the oracle does, slowly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..native.decide import Scores
from ..native.map import Map
from . import reference
from .deciding import has_core
from .matching import Vectors, real_tensor
from .sequences import runs
from .sweep import COLUMNS


class Comparison(Scores):
    """The queries of one sequence against all rows of a map: of each query the cosines ``(R,)`` of
    the best anchor or move.

    Args:
        scores: of all queries, arrays or computed on demand.
        width: of the sweep, in columns on each side.
        excluded: ``(Q, R)`` bool, rows that are no candidates.
    """

    def __init__(self, scores: Scores, width: int = 0, excluded: Tensor | None = None) -> None:
        self.width, self._scores, self._excluded = width, scores, excluded

    def __len__(self) -> int:
        return len(self._scores)

    def __getitem__(self, query: int, /) -> Tensor:
        found = torch.as_tensor(self._scores[query])
        if self._excluded is not None:
            found = found.masked_fill(self._excluded[query], -torch.inf)
        return found

    def whole(self) -> Tensor:
        """``(Q, R)`` float32."""
        return torch.stack([self[query] for query in range(len(self))])


class ReferenceRows:
    """Rows of a map, and the sequence of each, whose frames stand together.

    Args:
        rows: vectors ``(R, D)`` float, of length 1 or zero for an empty frame, or signs
            ``(R, columns, ...)`` uint8, eight in a byte; see `channels.signs`.
        sequences: of the rows.
        means: ``(S, ...)`` of the S sequences, see `search.sums.sums`, if the rows are only some of
            theirs.

    Raises:
        ValueError: the rows are no such array.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.recognition.comparison import ReferenceRows
        >>> rows = ReferenceRows(torch.eye(3), ["a"] * 3)
        >>> rows.compare(torch.eye(3)[1:2], False, False)[0]
        tensor([0., 1., 0.])
    """

    def __init__(
        self, rows: Vectors, sequences: Sequence[str], means: Tensor | None = None
    ) -> None:
        self._rows, self._sequences = _array(rows), sequences
        self._means = None if means is None else _array(means)
        self._maps: dict[bool, Map] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def compare(
        self,
        queries: Tensor,
        standardised: bool,
        sweep: bool,
        excluded: Tensor | None = None,
        mean: Tensor | None = None,
    ) -> Comparison:
        """Compares the queries of one sequence, ``(Q, *shape)``, or ``(Q, S, *shape)`` from
        `sweep.COLUMNS`.

        Args:
            queries: raw descriptors.
            standardised: subtract the mean of each traverse, see `standardise`.
            sweep: use all anchors, as wide a sweep as suits the scores, see `sweep`, or of signs
                moves by up to two columns to both sides.
            excluded: ``(Q, R)`` bool, rows that are no candidates.
            mean: of the sequence, see `search.sums.sums`, if the queries are only some of it; it is
                subtracted, and all anchors count.
        """
        given = _array(queries)
        swept = sweep and given.dtype == np.float32 and given.ndim == 3
        if swept and mean is None and given.shape[1] != len(COLUMNS):
            raise ValueError(
                f"expected (Q, {len(COLUMNS)}, D) for columns {COLUMNS}, got {given.shape}"
            )
        less = None if mean is None else _array(mean)
        scores, width = self._compared(given, standardised, sweep, less)
        return Comparison(scores, COLUMNS[len(COLUMNS) // 2 + width], excluded)

    def _compared(
        self, given: Array, standardised: bool, sweep: bool, mean: Array | None
    ) -> tuple[Any, int]:
        """Scores, and the width of the sweep in anchors to each side."""
        if has_core():
            found = self._map(standardised).compare(
                "references", given, standardised, sweep, torch.get_num_threads(), mean
            )
            return found, found.width
        means = self._means
        if means is not None:
            means = means.repeat([len(run) for run in runs(self._sequences)], axis=0)
        rest = self._rows, self._sequences, standardised, sweep, means, mean
        if given.dtype == np.uint8:
            return reference.compare_signs(given, *rest).astype(np.float32), 0
        anchors = given.reshape(len(given), -1, given.shape[-1])
        scores, width = reference.compare_vectors(anchors, *rest)
        return scores.astype(np.float32), width

    def _map(self, standardised: bool) -> Map:
        if standardised not in self._maps:
            drives = runs(self._sequences) if standardised else [self._rows]
            town = Map([len(each) for each in drives if len(each)])
            town.add("references", self._rows, means=self._means if standardised else None)
            self._maps[standardised] = town
        return self._maps[standardised]


Array = npt.NDArray[Any]


def _array(rows: Vectors) -> Array:
    tensor = real_tensor(rows)
    kept = tensor if tensor.dtype == torch.uint8 else tensor.float()
    return kept.numpy(force=True)


class Member(NamedTuple):
    """One channel among those that are fused: raw descriptors of all queries, the map, and how much
    the channel counts before anything is known of a drive."""

    queries: Tensor
    references: ReferenceRows
    trust: float = 1.0
