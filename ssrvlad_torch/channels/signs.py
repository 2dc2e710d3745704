"""Signs: descriptors of bits on a grid of cells, compared by how many agree.

A descriptor is ``(columns, rows, bytes)`` uint8; a bit is 1 for plus and 0 for minus. The score is
the cosine of the numbers 1 and -1, or of these without the mean of each traverse. A query is also
moved by columns to each side; the columns that overlap count, and the best move. Not in the paper.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..native import core
from ..recognition.comparison import Comparison
from ..recognition.follow import in_blocks
from ..recognition.matching import Vectors, real_tensor
from ..recognition.sequences import runs
from ..recognition.standardise import sharing

REACH = 2
"""Columns by which a query is moved to each side."""

_ROWS_AT_ONCE = 256
_LEAST = 1e-3


def moved(grids: Tensor, columns: int) -> Tensor:
    """``(N, columns, ...)`` moved to the right by some columns; zero comes in from outside."""
    after, kept = torch.zeros_like(grids), max(0, grids.shape[1] - abs(columns))
    to, source = max(0, columns), max(0, -columns)
    after[:, to : to + kept] = grids[:, source : source + kept]
    return after


def numbers(signs: Tensor) -> Tensor:
    """Signs ``(..., bytes)`` as 1 and -1, ``(..., 8 * bytes)`` float32."""
    bits = np.unpackbits(signs.numpy(force=True), axis=-1, bitorder="little")
    return torch.from_numpy(bits).float().mul_(2).sub_(1)


def products(queries: Tensor, masks: Tensor, references: Tensor) -> Tensor:
    """``(Q, R)`` int32 products of the numbers 1 and -1 of queries ``(Q, B)`` and references
    ``(R, B)`` uint8, over the bits that are set in the masks; B is a multiple of 8 for the
    native core."""
    counted = numbers(masks).add_(1).div_(2)
    library = core().library
    if library is None or queries.shape[1] % 8:
        signed = numbers(queries) * counted
        parts = [signed @ numbers(part).T for part in references.split(_ROWS_AT_ONCE)]
        return torch.cat([signed[:, :0], *parts], 1).int()
    queries, masks, references = (each.contiguous() for each in (queries, masks, references))
    different = torch.empty((len(queries), len(references)), dtype=torch.int32)
    library.ssrvlad_differing(
        queries.data_ptr(), masks.data_ptr(), len(queries), references.data_ptr(), len(references),
        queries.shape[1] // 8, torch.get_num_threads(), different.data_ptr(),
    )  # fmt: skip
    return counted.sum(1, dtype=torch.int32)[:, None] - 2 * different


def weighed(signs: Tensor, weights: Tensor) -> Tensor:
    """``(N, columns)`` float32, for each column of signs ``(N, columns, rows, bytes)`` the product
    of its numbers 1 and -1 with weights ``(columns, D)``."""
    sums, library = torch.empty(signs.shape[:2]), core().library
    if library is None:
        for first in range(0, len(signs), _ROWS_AT_ONCE):
            part = slice(first, first + _ROWS_AT_ONCE)
            sums[part] = torch.einsum("ncd,cd->nc", numbers(signs[part]).flatten(2), weights)
        return sums
    nibbles = numbers(torch.arange(16, dtype=torch.uint8)[:, None])[:, :4]
    table = (weights.reshape(-1, 4) @ nibbles.T).contiguous()
    packed = signs.contiguous()
    library.ssrvlad_weigh(
        packed.data_ptr(), len(packed), packed[:1].numel(), packed.shape[1], table.data_ptr(),
        torch.get_num_threads(), sums.data_ptr(),
    )  # fmt: skip
    return sums


class SignReferences:
    """The signs ``(R, columns, rows, bytes)`` of a map, and the sequence of each."""

    def __init__(self, signs: Vectors, sequences: Sequence[str]) -> None:
        self._signs, self._sequences = real_tensor(signs), sequences
        self._rows: dict[bool, SignRows] = {}

    def __len__(self) -> int:
        return len(self._signs)

    def compare(
        self, queries: Tensor, standardised: bool, sweep: bool, excluded: Tensor | None = None
    ) -> Comparison:
        """See `References`; the sweep moves queries by up to `REACH` columns."""
        if standardised not in self._rows:
            sequences = self._sequences if standardised else None
            self._rows[standardised] = SignRows(self._signs, sequences)
        rows, reach = self._rows[standardised], REACH if sweep else 0
        moved = SignQueries(queries, rows, standardised, reach)
        return Comparison(in_blocks(moved.scores, len(queries), len(rows), moved.moves, excluded))


class SignRows:
    """References ``(R, columns, rows, bytes)`` uint8 for many queries.

    With the traverse of each, the frames of one together, their means are subtracted, see
    `standardise.sharing`: ``means`` ``(T, columns, D)`` float32 from the numbers 1 and -1 of the
    ``traverse`` ``(R,)`` of each row. ``squares`` ``(R, columns)`` float32 are squared lengths of
    the columns without them.
    """

    def __init__(self, signs: Tensor, sequences: Sequence[str] | None = None) -> None:
        self.signs = signs
        lengths, shared = [len(signs)], dict[tuple[int, ...], tuple[int, ...]]()
        if sequences is not None and len(signs):
            lengths = [len(part) for part in runs(sequences)]
            shared = sharing(lengths)
        parts = signs.split(lengths)
        self.traverse = torch.arange(len(parts)).repeat_interleave(torch.tensor(lengths))
        self.means = torch.zeros(len(parts), signs.shape[1], 8 * signs.shape[2:].numel())
        for group, of in shared.items():
            self.means[list(group)] = mean_of(*(parts[each] for each in of))
        self.squares = torch.cat([*map(squares, parts, self.means)])

    def __len__(self) -> int:
        return len(self.signs)

    def dot(self, vectors: Tensor) -> Tensor:
        """``(N, R)`` float32 products of ``(N, columns, D)`` with the numbers 1 and -1."""
        if not vectors.any():
            return torch.zeros(len(vectors), len(self))
        return torch.stack([weighed(self.signs, each).sum(1) for each in vectors])


class SignQueries:
    """The queries of one traverse, to be compared with rows.

    Args:
        signs: ``(Q, columns, rows, bytes)`` uint8.
        references: what they are compared with.
        standardised: subtract the mean of the queries.
        reach: columns by which queries are moved to each side.

    Attributes:
        moves: number of moves of each query.

    Examples:
        >>> signs = torch.arange(96, dtype=torch.uint8).view(3, 4, 2, 4)
        >>> SignQueries(signs[1:2], SignRows(signs)).scores().argmax(1)
        tensor([1])
    """

    def __init__(
        self, signs: Tensor, references: SignRows, standardised: bool = False, reach: int = REACH
    ) -> None:
        steps = range(-reach, reach + 1)
        whole = torch.full((1, *signs.shape[1:]), 255, dtype=torch.uint8)
        mean = torch.zeros_like(references.means[:1])
        if standardised and len(signs):
            mean = mean_of(signs)[None]
        self.moves, self._references = len(steps), references
        self._moved = torch.stack([moved(signs, step) for step in steps], 1)
        self._masks = torch.cat([moved(whole, step) for step in steps])
        self._means = torch.cat([moved(mean, step) for step in steps])
        own = squares(signs, mean[0])
        self._lengths = torch.stack([moved(own, step).sum(1).sqrt() for step in steps], 1)
        self._of_rows = references.dot(self._means)
        kept = self._masks.flatten(2).any(2).float()
        self._row_lengths = (kept @ references.squares.T).sqrt()

    def __len__(self) -> int:
        return len(self._moved)

    def scores(self, part: slice = slice(None)) -> Tensor:
        """``(Q, R)`` float32 cosines of some of the queries, each for its best move."""
        queries, rows = self._moved[part], self._references
        known = (queries, self._masks.expand_as(queries))
        packed, masks = (each.flatten(0, 1).flatten(1) for each in known)
        flat = products(packed, masks, rows.signs.flatten(1))
        best = torch.full((len(queries), len(rows)), -torch.inf)
        means = rows.means.flatten(1)
        for move, product in enumerate(flat.view(len(queries), self.moves, len(rows)).unbind(1)):
            counted = numbers(self._masks[move]).flatten().add_(1).div_(2)
            signed = numbers(queries[:, move]).flatten(1).mul_(counted)
            offset = (self._means[move].flatten() - signed) @ means.T
            score = offset[:, rows.traverse].add_(product).sub_(self._of_rows[move])
            length = self._lengths[part, move, None] * self._row_lengths[move]
            torch.maximum(best, score.div_(length.clamp_(min=_LEAST)), out=best)
        return best.clamp_(max=1)


def squares(signs: Tensor, mean: Tensor) -> Tensor:
    """``(N, columns)`` float32, squared lengths of the columns of the numbers 1 and -1 of a
    traverse without its mean ``(columns, D)``."""
    if not mean.any():
        return torch.full(signs.shape[:2], float(mean.shape[1]))
    return (mean.shape[1] + mean.square().sum(1)).sub(weighed(signs, mean), alpha=2).clamp_(min=0)


def mean_of(*signs: Tensor) -> Tensor:
    """``(columns, D)`` float32, the mean of the numbers 1 and -1 of signs ``(N, columns, rows,
    bytes)``; zero if all their frames are equal, which the mean would leave nothing of."""
    ones, frames = np.zeros((*signs[0].shape[1:-1], 8 * signs[0].shape[-1]), np.int64), 0
    for part in (part for each in signs for part in each.split(_ROWS_AT_ONCE)):
        bits = np.unpackbits(part.numpy(force=True), axis=-1, bitorder="little")
        ones += bits.sum(0, dtype=np.uint32)
        frames += len(part)
    mean = torch.from_numpy(2 * ones / frames - 1).float().flatten(1)
    return mean.zero_() if bool((mean.abs() == 1).all()) else mean
