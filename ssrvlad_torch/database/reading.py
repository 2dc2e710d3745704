"""Reading the rows of a table with verified checksums: all, or those that are not damaged."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from ..channels import Column
from ..files import natural_key
from .engine import lance, lance_errors, write_fragments
from .frames import FrameSet
from .rows import POSE, intact, matrix

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import LanceFragment

_BATCH = 4096


class Damage(NamedTuple):
    """A file below the database's folder, the number of frames that are lost, and a line why."""

    file: str
    rows: int
    reason: str


def read_rows(table: LanceDataset, damage: list[Damage]) -> Iterator[pa.RecordBatch]:
    """The intact rows in the order in which they are stored; damage is appended to ``damage``."""
    for fragment in table.get_fragments():
        yield from read_intact(fragment, damage)


def read_intact(fragment: LanceFragment, damage: list[Damage]) -> Iterator[pa.RecordBatch]:
    """The intact rows of a data file, up to where it cannot be read; its damage is appended to
    ``damage`` at the end."""
    intact_rows, reason = 0, ""
    file = f"data/{fragment.metadata.files[0].path}"
    try:
        with lance_errors(ValueError, file):
            for batch in fragment.to_batches(batch_size=_BATCH):
                fits = intact(batch)
                if not fits.all():
                    frame = batch["frame"][int(np.argmin(fits))].as_py()
                    reason = reason or f"the checksum of frame {frame!r} differs"
                intact_rows += int(fits.sum())
                yield batch if fits.all() else batch.filter(pa.array(fits))
    except ValueError as error:
        reason = reason or str(error).removeprefix(f"{file}: ")
    if reason:
        damage.append(Damage(file, fragment.metadata.num_rows - intact_rows, reason))


def without_damage(table: LanceDataset, damage: list[Damage]) -> Any:
    """The operation that replaces damaged data files by their intact rows, ``None`` without damage;
    ``damage`` is set to what is damaged."""
    damage.clear()
    damaged = []
    for fragment in table.get_fragments():
        before = len(damage)
        deque(read_intact(fragment, damage), maxlen=0)
        damaged += [fragment] if len(damage) > before else []
    if not damaged:
        return None
    batches = (batch for fragment in damaged for batch in read_intact(fragment, []))
    rows = pa.RecordBatchReader.from_batches(table.schema, batches)
    return lance().LanceOperation.Update(
        removed_fragment_ids=[fragment.fragment_id for fragment in damaged],
        new_fragments=write_fragments(table, rows),
    )


FRAME_SET_COLUMNS = ["frame", "sequence", *POSE, "stamp", "empty"]
"""The columns that a `FrameSet` holds beside descriptors."""


def load_descriptors(
    table: LanceDataset, columns: Sequence[Column], order: npt.NDArray[np.int64]
) -> dict[str, npt.NDArray[Any]]:
    """``(R, *shape)`` by column: the rows of a table in an order. Damage is a ValueError."""
    rows, done, damage = np.argsort(order), 0, list[Damage]()
    arrays = {column.name: column.zeros(len(rows)) for column in columns}
    for batch in read_rows(table, damage):
        for column in columns:
            values = matrix(batch[column.name]).reshape(-1, *column.shape)
            arrays[column.name][rows[done : done + len(batch)]] = values
        done += len(batch)
    if damage:
        raise ValueError(f"{table.uri} is damaged: {damage[0].file}: {damage[0].reason}")
    return arrays


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
    return len(pc.unique(pc.replace_substring_regex(names, "[0-9]", "0"))) == 1


def frame_set(table: pa.Table) -> FrameSet:
    """The frames of a table with `FRAME_SET_COLUMNS`, without descriptors."""
    return FrameSet(
        frames=tuple(table["frame"].to_pylist()),
        sequences=tuple(table["sequence"].to_pylist()),
        channels={},
        poses=np.stack([table[axis].to_numpy() for axis in POSE], axis=1),
        stamps=table["stamp"].to_numpy(),
        empty=table["empty"].to_numpy(),
    )
