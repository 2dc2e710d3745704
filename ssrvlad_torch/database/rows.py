"""A frame as a row of the table, and the checksum that covers every column of it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from .frames import FrameRecord

POSE = ["x", "y", "heading"]
OF_A_RECORD = ["frame", "sequence", *POSE, "stamp", "signature", "digest", "height", "width"]
OF_A_RECORD += ["origin"]

Words = npt.NDArray[np.uint64]

_MULTIPLIER = 0x9E3779B97F4A7C15
_INVERSE = pow(_MULTIPLIER, -1, 1 << 64)


def schema(width: int) -> pa.Schema:
    """The columns of a database of descriptors of ``width`` numbers."""
    kinds = dict.fromkeys(OF_A_RECORD, pa.string())
    kinds |= dict.fromkeys([*POSE, "stamp"], pa.float64())
    kinds |= {"height": pa.int32(), "width": pa.int32(), "empty": pa.bool_()}
    kinds |= {"descriptor": pa.list_(pa.float32(), width), "checksum": pa.uint64()}
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in kinds.items()])


def to_table(records: Sequence[FrameRecord], descriptors: npt.NDArray[np.float32]) -> pa.Table:
    """N records and their ``(N, D)`` float32 descriptors as rows."""
    width = descriptors.shape[1]
    columns: dict[str, Any] = {
        name: [getattr(record, name) for record in records] for name in OF_A_RECORD
    }
    flat = pa.array(np.ascontiguousarray(descriptors).ravel())
    columns["empty"] = ~descriptors.any(axis=1)
    columns["descriptor"] = pa.FixedSizeListArray.from_arrays(flat, width)
    columns["checksum"] = np.zeros(len(records), np.uint64)
    table = pa.table(columns, schema=schema(width))
    place = table.schema.get_field_index("checksum")
    return table.set_column(place, table.schema.field(place), pa.array(checksums(table)))


def to_record(frame: str, sequence: str, *others: Any) -> FrameRecord:
    """The record of a row, from its columns `OF_A_RECORD`."""
    return FrameRecord(sequence, frame[len(sequence) + 1 :] if sequence else frame, *others)


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


def _hashed_rows(values: npt.NDArray[np.float32]) -> Words:
    """Of each row of a matrix: its words, two numbers each, times odd numbers, summed."""
    if values.shape[1] % 2:
        values = np.pad(values, ((0, 0), (0, 1)))
    words = np.ascontiguousarray(values).view(np.uint64)
    hashed: Words = words @ _powers(_MULTIPLIER, words.shape[1])
    return hashed


def _hashed_text(column: pa.StringArray) -> Words:
    """Of each text: its bytes as a polynomial, from sums over all bytes up to each place."""
    _, offsets_of, content = column.buffers()
    if content is None:
        return np.zeros(len(column), np.uint64)
    offsets = np.frombuffer(offsets_of, np.int32)[column.offset : column.offset + len(column) + 1]
    begin, end = offsets[0], offsets[-1]
    numbers: Words = np.frombuffer(content, np.uint8)[begin:end].astype(np.uint64) + np.uint64(1)
    sums: Words = np.zeros(len(numbers) + 1, np.uint64)
    np.cumsum(numbers * _powers(_MULTIPLIER, len(numbers)), out=sums[1:])
    places = offsets - begin
    shifted = np.subtract(sums[places[1:]], sums[places[:-1]], dtype=np.uint64)
    hashed: Words = shifted * _powers(_INVERSE, len(numbers) + 1)[places[:-1]]
    return hashed


def _powers(base: int, count: int) -> Words:
    return _table_of_powers(base, 1 << max(1023, count - 1).bit_length())[:count]


@cache
def _table_of_powers(base: int, count: int) -> Words:
    return np.cumprod(np.full(count, base, np.uint64), dtype=np.uint64)
