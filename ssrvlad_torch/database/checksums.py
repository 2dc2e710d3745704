"""The checksum of a row, which covers all its columns."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

Words = npt.NDArray[np.uint64]

_MULTIPLIER = 0x9E3779B97F4A7C15


def intact(table: pa.Table | pa.RecordBatch) -> npt.NDArray[np.bool_]:
    """``(N,)`` bool, the rows whose checksum is correct."""
    fits: npt.NDArray[np.bool_] = checksums(table) == table["checksum"].to_numpy()
    return fits


def checksums(rows: pa.Table | pa.RecordBatch) -> Words:
    """``(N,)`` uint64, the checksum of each row, over all columns but ``checksum``. Any change of a
    single word of a row changes its checksum: words are multiplied by odd numbers modulo 2^64,
    which is one to one."""
    if isinstance(rows, pa.Table):
        parts = [checksums(batch) for batch in rows.to_batches()]
        return np.concatenate([np.zeros(0, np.uint64), *parts])
    total = np.zeros(rows.num_rows, np.uint64)
    for name, column in zip(rows.schema.names, rows.columns, strict=True):
        if name == "checksum":
            continue
        if pa.types.is_string(column.type):
            # the hash of the bytes of each text, padded to a row of a matrix, plus its length
            _, offsets, content = column.buffers()
            ends = np.frombuffer(offsets, np.int32)[column.offset :][: len(column) + 1]
            lengths = np.diff(ends)
            text = np.frombuffer(content or b"", np.uint8)[ends[0] : ends[-1]]
            padded = np.zeros((len(column), lengths.max(initial=0)), np.uint8)
            if text.size == padded.size:
                padded.ravel()[:] = text
            else:
                padded[np.arange(padded.shape[1], dtype=np.int32) < lengths[:, None]] = text
            words = _hash_rows(padded) + lengths.astype(np.uint64)
        elif pa.types.is_fixed_size_list(column.type):
            words = _hash_rows(matrix(column))
        else:
            values = column.to_numpy(zero_copy_only=False)
            is_real = values.dtype == np.float64
            words = values.view(np.uint64) if is_real else values.astype(np.uint64)
        total = (total ^ words) * np.uint64(_MULTIPLIER)
    return total


def matrix(column: pa.ChunkedArray | pa.Array) -> npt.NDArray[Any]:
    """A column of ``(N, D)`` float32 numbers or uint8 signs; of one chunk, not copied."""
    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    values: npt.NDArray[Any] = column.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(len(column), column.type.list_size)


def _hash_rows(values: npt.NDArray[Any]) -> Words:
    """For each row of a matrix, the sum of its words of 8 bytes, each times its own odd number."""
    padding = -values.shape[1] % (8 // values.itemsize)
    if padding:
        values = np.pad(values, ((0, 0), (0, padding)))
    words = np.ascontiguousarray(values).view(np.uint64)
    numbers = np.cumprod(np.full(words.shape[1], _MULTIPLIER, np.uint64), dtype=np.uint64)
    hashes: Words = np.einsum("ij,j->i", words, numbers)
    return hashes
