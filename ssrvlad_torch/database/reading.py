"""Reading the rows of a table, each verified by its checksum; what is damaged has a name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyarrow as pa

from .engine import file_names, one_line
from .rows import intact

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import LanceFragment

_BATCH = 4096
_BLOCK = 256


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
        ValueError: a file is missing or a row is not as it was written.
    """
    for fragment in table.get_fragments():
        if damage is None:
            yield from _whole(table, fragment)
        else:
            batches, lost = read_intact(fragment)
            damage += lost
            yield from batches


def read_intact(fragment: LanceFragment) -> tuple[list[pa.RecordBatch], list[Damage]]:
    """The rows of a fragment that are as they were written, and what is not."""
    name = file_names(fragment.metadata)[0]
    try:
        batches = list(fragment.to_batches(batch_size=_BATCH))
    except (OSError, ValueError, RuntimeError, pa.ArrowException) as error:
        return _block_by_block(fragment, name, one_line(error))
    return _sift(batches, name)


def _whole(table: LanceDataset, fragment: LanceFragment) -> Iterator[pa.RecordBatch]:
    name = file_names(fragment.metadata)[0]
    try:
        for batch in fragment.to_batches(batch_size=_BATCH):
            fits = intact(batch)
            if not fits.all():
                first = batch["frame"][int(np.argmin(fits))].as_py()
                raise ValueError(
                    f"frame {first!r} of {name} is not as it was written: its checksum differs"
                )
            yield batch
    except (OSError, ValueError, RuntimeError, pa.ArrowException) as error:
        raise ValueError(f"{table.uri} is damaged: {one_line(error)}") from error


def _sift(batches: list[pa.RecordBatch], name: str) -> tuple[list[pa.RecordBatch], list[Damage]]:
    kept, lost = [], 0
    for batch in batches:
        fits = intact(batch)
        lost += int((~fits).sum())
        kept.append(batch if fits.all() else batch.filter(pa.array(fits)))
    return kept, [Damage(name, lost, "checksums of rows differ")] if lost else []


def _block_by_block(
    fragment: LanceFragment, name: str, reason: str
) -> tuple[list[pa.RecordBatch], list[Damage]]:
    """What can be read of a file that cannot be read through."""
    try:
        rows = fragment.count_rows()
    except (OSError, ValueError, RuntimeError) as error:
        return [], [Damage(name, fragment.physical_rows, one_line(error))]
    kept: list[pa.RecordBatch] = []
    for first in range(0, rows, _BLOCK):
        try:
            block = fragment.take(list(range(first, min(first + _BLOCK, rows))))
            kept += _sift(block.to_batches(), name)[0]
        except (OSError, ValueError, RuntimeError, pa.ArrowException):
            continue
    return kept, [Damage(name, rows - sum(map(len, kept)), reason)]
