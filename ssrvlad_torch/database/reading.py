"""Reading the rows of a table, each verified by its checksum; what is damaged has a name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyarrow as pa

from .engine import one_line
from .rows import intact

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import LanceFragment

_BATCH, _BLOCK = 4096, 256
_ERRORS = (OSError, ValueError, RuntimeError, pa.ArrowException)


class Damage(NamedTuple):
    """Something that is not as it was written.

    Attributes:
        file: its path below the database's folder.
        rows: how many frames are lost.
        reason: what is wrong, one line.
    """

    file: str
    rows: int
    reason: str


def read_rows(table: LanceDataset, damage: list[Damage] | None = None) -> Iterator[pa.RecordBatch]:
    """All rows in the order in which they are stored.

    Args:
        table: the version that is read.
        damage: where given, what is damaged is left out and told here.

    Raises:
        ValueError: a file is missing or a row is not as it was written; at the end of the file.
    """
    for fragment in table.get_fragments():
        lost: list[Damage] = []
        yield from read_intact(fragment, lost)
        if lost and damage is None:
            raise ValueError(f"{table.uri} is damaged: {lost[0].file}: {lost[0].reason}")
        if damage is not None:
            damage += lost


def read_intact(fragment: LanceFragment, damage: list[Damage]) -> Iterator[pa.RecordBatch]:
    """The rows of a fragment that are as they were written; what is not is told in damage."""
    kept, reason = 0, ""
    for batch in _batches(fragment):
        if isinstance(batch, str):
            reason = reason or batch
            continue
        fits = intact(batch)
        if not fits.all():
            first = batch["frame"][int(np.argmin(fits))].as_py()
            reason = reason or f"the checksum of frame {first!r} differs"
        kept += int(fits.sum())
        yield batch if fits.all() else batch.filter(pa.array(fits))
    if reason:
        try:
            rows = fragment.count_rows()
        except _ERRORS:
            rows = fragment.physical_rows
        file = f"data/{fragment.metadata.files[0].path}"
        damage.append(Damage(file, rows - kept, reason))


def is_damaged(fragment: LanceFragment, damage: list[Damage]) -> bool:
    """Whether a fragment is damaged; how is told in damage."""
    before = len(damage)
    for _ in read_intact(fragment, damage):
        pass
    return len(damage) > before


def _batches(fragment: LanceFragment) -> Iterator[pa.RecordBatch | str]:
    """The rows of a fragment, and why some cannot be read; of these, the blocks that can be."""
    done = 0
    try:
        for batch in fragment.to_batches(batch_size=_BATCH):
            yield batch
            done += len(batch)
        return
    except _ERRORS as error:
        yield one_line(error)
    try:
        rows = fragment.count_rows()
    except _ERRORS:
        return
    for first in range(done, rows, _BLOCK):
        try:
            yield from fragment.take(list(range(first, min(first + _BLOCK, rows)))).to_batches()
        except _ERRORS:
            continue
