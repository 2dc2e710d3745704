"""Camera: how the camera of queries differs from that of a map, seen by the signs of their cells.

Of queries and the map frames that show their places it is asked how cells must be moved, and
spread from the middle, to agree best. Not in the paper."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .signs import ACROSS, DOWN

SPREADS = (-0.1, 0.1, -0.2, 0.2, -0.3, 0.3)
"""By which cells are moved, of their distance from the middle: where the field of view differs."""
LEAST_PAIRS, MOST_PAIRS = 10, 64
"""Fewer tell nothing, and more are not needed."""
ALIKE = 0.92
"""Cells that agree so well spread, as a fraction of how well without, show another field of view.
In 14 pairs of sequences by one camera it is at most 0.89; if pictures were cut to 0.75, 0.96."""


CLEAR = 0.03
"""How much better than by the median move cells must agree. In twelve pairs of sequences of one
place it is at least 0.045, with three networks, in two of different places at most 0.014."""


class Camera(NamedTuple):
    """How queries look at the places of a map, in cells of which a picture has 16 x 16.

    Attributes:
        right, down: by how many columns and rows they look further to the right and down.
        other_view: whether their field of view is wider or narrower. Then answers may be some
            frames ahead or behind.
    """

    right: int = 0
    down: int = 0
    other_view: bool = False

    def __str__(self) -> str:
        turned = [
            f"{abs(cells)} of 16 {kind} {to[cells < 0]}"
            for cells, kind, to in (
                (self.right, "columns", ("to the right", "to the left")),
                (self.down, "rows", ("down", "up")),
            )
            if cells
        ]
        words = [f"turned {' and '.join(turned)}"] if turned else []
        words += ["with another field of view"] if self.other_view else []
        return ", ".join(words) or "alike"


def camera_of(queries: npt.NDArray[np.uint8], frames: npt.NDArray[np.uint8]) -> Camera | None:
    """The camera of queries, by their signs ``(N, columns, rows, bytes)`` and those of the frames
    that show the same places; nothing of fewer than `LEAST_PAIRS`, and where no move is `CLEAR`."""
    if len(queries) < LEAST_PAIRS:
        return None
    agreement = _agreement(queries, frames)
    moves = _moves(agreement, 0)
    best, right, down = max(moves)
    spread = max(value for spread in SPREADS for value, *_ in _moves(agreement, spread))
    if max(best, spread) < np.median([value for value, *_ in moves]) + CLEAR:
        return None
    return Camera(right, down, spread > ALIKE * best)


def _agreement(
    queries: npt.NDArray[np.uint8], frames: npt.NDArray[np.uint8]
) -> npt.NDArray[np.float32]:
    """``(2 * ACROSS + 1, 2 * DOWN + 1, columns, rows)``, for each move the mean cosine of the cells
    of the frames and those that come there; NaN where none does."""
    here, there = (
        2 * np.unpackbits(signs, axis=-1).astype(np.float32) - 1 for signs in (queries, frames)
    )
    around = [(0, 0), (ACROSS, ACROSS), (DOWN, DOWN), (0, 0)]
    padded = np.pad(here, around, constant_values=np.nan)
    columns, rows, bits = there.shape[1:]
    agreement = np.empty((2 * ACROSS + 1, 2 * DOWN + 1, columns, rows), np.float32)
    for right, down in product(range(2 * ACROSS + 1), range(2 * DOWN + 1)):
        first, top = 2 * ACROSS - right, 2 * DOWN - down
        moved = padded[:, first : first + columns, top : top + rows]
        agreement[right, down] = np.einsum("ncrb,ncrb->cr", moved, there) / (len(there) * bits)
    return agreement


def _moves(agreement: npt.NDArray[np.float32], spread: float) -> list[tuple[float, int, int]]:
    """For each move how much all cells agree, spread, and the move."""
    columns, rows = (np.arange(count) for count in agreement.shape[2:])
    moves = list[tuple[float, int, int]]()
    for right, down in product(range(-ACROSS, ACROSS + 1), range(-DOWN, DOWN + 1)):
        of_columns, of_rows = (
            np.clip(np.rint((cells - cells.mean()) * spread).astype(np.int64) + move, -most, most)
            + most
            for cells, move, most in ((columns, right, ACROSS), (rows, down, DOWN))
        )
        cells = agreement[of_columns[:, None], of_rows, columns[:, None], rows]
        moves.append((float(np.nanmean(cells)), right, down))
    return moves
