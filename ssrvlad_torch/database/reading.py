"""Reading the rows of a table with verified checksums, and dropping damaged ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from .checksums import intact
from .engine import lance, message_of, write_fragments

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import LanceFragment

_BATCH, _BLOCK = 4096, 256
_ERRORS = (OSError, ValueError, RuntimeError, pa.ArrowException)


class Damage(NamedTuple):
    """A file below the database's folder, the number of frames that are lost, and a line why."""

    file: str
    rows: int
    reason: str


def read_rows(table: LanceDataset, damage: list[Damage] | None = None) -> Iterator[pa.RecordBatch]:
    """All rows in the order in which they are stored. Damaged ones are left out and reported in
    ``damage``; without it, they are a ValueError after the intact rows of the file."""
    for fragment in table.get_fragments():
        lost: list[Damage] = []
        yield from read_intact(fragment, lost)
        if lost and damage is None:
            raise ValueError(f"{table.uri} is damaged: {lost[0].file}: {lost[0].reason}")
        if damage is not None:
            damage += lost


def read_intact(fragment: LanceFragment, damage: list[Damage]) -> Iterator[pa.RecordBatch]:
    """The intact rows of a fragment; its damage is appended to ``damage`` at the end."""
    intact_rows, reason = 0, ""
    for batch in _batches(fragment):
        if isinstance(batch, str):
            reason = reason or batch
            continue
        fits = intact(batch)
        if not fits.all():
            first = batch["frame"][int(np.argmin(fits))].as_py()
            reason = reason or f"the checksum of frame {first!r} differs"
        intact_rows += int(fits.sum())
        yield batch if fits.all() else batch.filter(pa.array(fits))
    if reason:
        try:
            rows = fragment.count_rows()
        except _ERRORS:
            rows = fragment.physical_rows
        file = f"data/{fragment.metadata.files[0].path}"
        damage.append(Damage(file, rows - intact_rows, reason))


def replacement_of_damaged(table: LanceDataset, damage: list[Damage]) -> Any:
    """The operation that replaces damaged fragments by their intact rows, ``None`` without damage;
    ``damage`` is set to what is damaged."""
    damage.clear()
    damaged = []
    for fragment in table.get_fragments():
        known = len(damage)
        deque(read_intact(fragment, damage), maxlen=0)
        if len(damage) > known:
            damaged.append(fragment)
    if not damaged:
        return None
    batches = (batch for fragment in damaged for batch in read_intact(fragment, []))
    rows = pa.RecordBatchReader.from_batches(table.schema, batches)
    return lance().LanceOperation.Update(
        removed_fragment_ids=[fragment.fragment_id for fragment in damaged],
        new_fragments=write_fragments(table, rows),
    )


def _batches(fragment: LanceFragment) -> Iterator[pa.RecordBatch | str]:
    """The rows of a fragment; after an error, its message and the blocks that can be read."""
    done = 0
    try:
        for batch in fragment.to_batches(batch_size=_BATCH):
            yield batch
            done += len(batch)
        return
    except _ERRORS as error:
        yield message_of(error)
    try:
        rows = fragment.count_rows()
    except _ERRORS:
        return
    for first in range(done, rows, _BLOCK):
        try:
            yield from fragment.take(list(range(first, min(first + _BLOCK, rows)))).to_batches()
        except _ERRORS:
            continue
