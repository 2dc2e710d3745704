"""Reading the rows of a table with verified checksums: one by one, dropped if damaged, or all."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from ..channels import Column
from ..files import natural_key
from .engine import lance, message_of, write_fragments
from .frames import FrameSet
from .rows import POSE, intact, matrix

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


FRAME_SET_COLUMNS = ["frame", "sequence", *POSE, "stamp", "empty"]
"""The columns that a `FrameSet` holds beside descriptors."""


def load_descriptors(
    table: LanceDataset, columns: Sequence[Column], order: npt.NDArray[np.int64]
) -> dict[str, npt.NDArray[Any]]:
    """``(R, *shape)`` by column: the verified rows of a table, see `Database.load`, in an order."""
    rows, done = np.argsort(order), 0
    arrays: dict[str, npt.NDArray[Any]] = {
        column.name: np.empty((len(rows), math.prod(column.shape)), column.dtype)
        for column in columns
    }
    for batch in read_rows(table):
        for name, values in arrays.items():
            values[rows[done : done + len(batch)]] = matrix(batch[name])
        done += len(batch)
    return {column.name: arrays[column.name].reshape(-1, *column.shape) for column in columns}


def order_of(table: pa.Table) -> npt.NDArray[np.int64]:
    """The rows sorted by sequence and name, both in natural order."""
    coded = pc.dictionary_encode(table["sequence"]).combine_chunks()
    sequences, codes = coded.dictionary.to_pylist(), coded.indices.to_numpy()
    rank = {sequence: n for n, sequence in enumerate(sorted(sequences, key=natural_key))}
    ranks = np.array([rank[sequence] for sequence in sequences], np.int64)[codes]
    names = pc.replace_substring_regex(table["frame"], "(?s)^.*/", "")
    if _differ_in_digits(names):
        by_name = np.asarray(pc.sort_indices(names)).astype(np.int64)  # by character, faster
    else:
        keys = [natural_key(name) for name in names.to_pylist()]
        by_name = np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)
    return by_name[np.argsort(ranks[by_name], kind="stable")]


def _differ_in_digits(names: pa.ChunkedArray) -> bool:
    """Whether texts are equal but for digits, which stand at the same places."""
    if len(pc.unique(pc.binary_length(names))) != 1:
        return False
    content = np.frombuffer("".join(names.to_pylist()).encode(), np.uint8)
    letters = content.reshape(len(names), -1).copy()
    letters[(letters >= ord("0")) & (letters <= ord("9"))] = ord("0")
    return bool((letters == letters[0]).all())


def frame_set(table: pa.Table) -> FrameSet:
    """The frames of a table with `FRAME_SET_COLUMNS`, without descriptors."""
    coded = pc.dictionary_encode(table["sequence"]).combine_chunks()
    names = np.array([*coded.dictionary.to_pylist(), None], object)
    return FrameSet(
        frames=tuple(table["frame"].to_pylist()),
        sequences=tuple(names[coded.indices.to_numpy()].tolist()),
        channels={},
        poses=np.stack([table[axis].to_numpy() for axis in POSE], axis=1),
        stamps=table["stamp"].to_numpy(),
        empty=table["empty"].to_numpy(),
    )
