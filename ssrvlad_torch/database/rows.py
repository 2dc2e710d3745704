"""A frame as a row of the table, and the checksum that covers every column of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from .frames import FrameRecord, Vectors

POSE = ["x", "y", "heading"]
OF_A_RECORD = ["frame", "sequence", *POSE, "stamp", "signature", "digest", "height", "width"]
OF_A_RECORD += ["origin"]

Words = npt.NDArray[np.uint64]

_MULTIPLIER = 0x9E3779B97F4A7C15

DESCRIPTOR = "descriptor"
"""The column of the method itself."""

Arrays = Mapping[str, npt.NDArray[np.float32]]
"""``(N, D)`` descriptors by their columns."""


def schema(widths: Mapping[str, int]) -> pa.Schema:
    """The columns of a database, those of descriptors by how many numbers they have."""
    kinds = dict.fromkeys(OF_A_RECORD, pa.string())
    kinds |= dict.fromkeys([*POSE, "stamp"], pa.float64())
    kinds |= {"height": pa.int32(), "width": pa.int32(), "empty": pa.bool_()}
    kinds |= {name: pa.list_(pa.float32(), width) for name, width in widths.items()}
    kinds["checksum"] = pa.uint64()
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in kinds.items()])


def to_table(records: Sequence[FrameRecord], descriptors: Arrays) -> pa.Table:
    """N records and their descriptors as rows."""
    form = schema({name: values.shape[1] for name, values in descriptors.items()})
    columns: dict[str, Any] = {
        name: [getattr(record, name) for record in records] for name in OF_A_RECORD
    }
    columns["empty"] = ~descriptors[DESCRIPTOR].any(axis=1)
    for name, values in descriptors.items():
        flat = pa.array(np.ascontiguousarray(values).ravel())
        columns[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    columns["checksum"] = np.zeros(len(records), np.uint64)
    table = pa.table(columns, schema=form)
    place = table.schema.get_field_index("checksum")
    return table.set_column(place, table.schema.field(place), pa.array(checksums(table)))


class KnownFrames(Mapping[str, FrameRecord]):
    """The records of a database by the frame's id, in the order in which they are stored.

    A record is made when it is asked for: of a million frames only the ids are Python's.

    Args:
        table: with the columns `OF_A_RECORD`.
    """

    def __init__(self, table: pa.Table) -> None:
        self._columns = [column.combine_chunks() for column in table.columns]
        self._rows = {frame: row for row, frame in enumerate(table["frame"].to_pylist())}

    def __getitem__(self, frame: str) -> FrameRecord:
        row = self._rows[frame]
        _, sequence, *others = (column[row].as_py() for column in self._columns)
        return FrameRecord(sequence, frame[len(sequence) + 1 :] if sequence else frame, *others)

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def folders(self) -> set[tuple[str, str]]:
        """See `folders_of`."""
        return folders_of(pa.table(self._columns, OF_A_RECORD))

    def column(self, name: str) -> list[Any]:
        """One attribute of all records, in their order."""
        values: list[Any] = self._columns[OF_A_RECORD.index(name)].to_pylist()
        return values


def folders_of(table: pa.Table) -> set[tuple[str, str]]:
    """The folders that rows were encoded from, each with its sequence; the folder is empty where it
    is not known."""
    parts = pc.split_pattern(table["signature"], "|", max_splits=1, reverse=True)
    without = pc.equal(pc.list_value_length(parts), 1)
    folder = pc.if_else(without, "", pc.list_element(parts, 0))
    pairs = pa.table({"folder": folder, "sequence": table["sequence"]})
    found = pairs.group_by(pairs.column_names).aggregate([])
    return set(zip(*found.to_pydict().values(), strict=True))


def matrix(column: pa.ChunkedArray | pa.Array) -> npt.NDArray[np.float32]:
    """``(N, D)`` float32 of a column of descriptors, without a copy where it is one chunk."""
    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    if isinstance(column, pa.ChunkedArray):  # of no chunks
        column = pa.concat_arrays(column.chunks)
    values: npt.NDArray[np.float32] = column.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(len(column), column.type.list_size)


def intact(table: pa.Table | pa.RecordBatch) -> npt.NDArray[np.bool_]:
    """``(N,)`` bool, the rows whose checksum fits."""
    fits: npt.NDArray[np.bool_] = checksums(table) == table["checksum"].to_numpy()
    return fits


def checksums(table: pa.Table | pa.RecordBatch) -> Words:
    """``(N,)`` uint64, of each row and all its columns but the checksum itself.

    Any change within one column changes it: a word of a column enters by a product with an odd
    number modulo 2^64, which no two words share.
    """
    total = np.zeros(table.num_rows, np.uint64)
    for field in table.schema:
        if field.name != "checksum":
            total = (total ^ _hashed(table[field.name])) * np.uint64(_MULTIPLIER)
    return total


def _hashed(column: pa.ChunkedArray | pa.Array) -> Words:
    if isinstance(column, pa.ChunkedArray):
        parts = [_hashed(chunk) for chunk in column.chunks]
        return np.concatenate([np.zeros(0, np.uint64), *parts])
    if pa.types.is_string(column.type):
        return _hashed_text(column)
    if pa.types.is_fixed_size_list(column.type):
        return _hashed_rows(matrix(column))
    values = column.to_numpy(zero_copy_only=False)
    words: Words = values.view(np.uint64) if values.dtype == float else values.astype(np.uint64)
    return words


def _hashed_rows(values: npt.NDArray[Any]) -> Words:
    """Of each row of a matrix: its words of 8 bytes times odd numbers, summed."""
    missing = -values.shape[1] % (8 // values.itemsize)
    if missing:
        values = np.pad(values, ((0, 0), (0, missing)))
    words = np.ascontiguousarray(values).view(np.uint64)
    hashed: Words = np.einsum("ij,j->i", words, _powers(words.shape[1]))
    return hashed


def _hashed_text(column: pa.StringArray) -> Words:
    """Of each text: its bytes as a row of a matrix, and its length."""
    _, offsets, content = column.buffers()
    ends = np.frombuffer(offsets, np.int32)[column.offset :][: len(column) + 1]
    lengths = np.diff(ends)
    text = np.frombuffer(content or b"", np.uint8)[ends[0] : ends[-1]]
    rows = np.zeros((len(column), lengths.max(initial=0)), np.uint8)
    if text.size == rows.size:
        rows.ravel()[:] = text
    else:
        rows[np.arange(rows.shape[1], dtype=np.int32) < lengths[:, None]] = text
    hashed: Words = _hashed_rows(rows) + lengths.astype(np.uint64)
    return hashed


@cache
def _powers(count: int) -> Words:
    return np.cumprod(np.full(count, _MULTIPLIER, np.uint64), dtype=np.uint64)


def fitting(name: str, descriptors: Vectors, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Descriptors as an array of this shape, whose rows have a length in float32.

    Raises:
        ValueError: they are not.
    """
    detached = getattr(descriptors, "detach", None)
    values = np.asarray(detached().cpu() if detached else descriptors, np.float32)
    if values.shape != shape:
        raise ValueError(f"{name}: expected {shape} for {shape[0]} frames, got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: values that are not finite")
    with np.errstate(over="ignore"):
        squares = np.einsum("ij,ij->i", values, values)
    if not np.isfinite(squares).all():
        raise ValueError(f"{name}: values too large for float32 to measure their length")
    if values[squares == 0].any():
        raise ValueError(f"{name}: values too small for float32 to measure their length")
    return values
