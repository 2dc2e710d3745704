"""The rows of a database in memory as a `FrameSet`, in natural order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from ..channels.column import Column
from ..files import natural_key
from .checksums import matrix
from .frames import FrameSet
from .reading import read_rows
from .rows import POSE, schema

if TYPE_CHECKING:
    from lance import LanceDataset

FRAME_SET_COLUMNS = ["frame", "sequence", *POSE, "stamp", "empty"]
"""The columns that a `FrameSet` holds beside descriptors."""

_BYTES_AT_ONCE = 64


def load_frame_set(table: LanceDataset, columns: Sequence[Column]) -> FrameSet:
    """See `Database.load`."""
    rows = table.count_rows()
    arrays: dict[str, npt.NDArray[Any]] = {
        column.name: np.empty((rows, math.prod(column.shape)), column.dtype) for column in columns
    }
    tables, done = [schema([]).empty_table().select(FRAME_SET_COLUMNS)], 0
    for batch in read_rows(table):
        for name, values in arrays.items():
            values[done : done + len(batch)] = matrix(batch[name])
        done += len(batch)
        copied = batch.select(FRAME_SET_COLUMNS).take(pa.array(np.arange(len(batch))))
        tables.append(pa.table(copied))  # a slice would keep the whole batch in memory
    others = pa.concat_tables(tables)
    twice = others.num_rows - len(pc.unique(others["frame"]))
    if twice:
        raise ValueError(f"{table.uri} is damaged: it holds {twice} frames twice")
    order = order_of(others)
    for column in columns:
        values = arrays[column.name]
        if (order[1:] < order[:-1]).any():
            step = _BYTES_AT_ONCE // values.itemsize
            for first in range(0, values.shape[1], step):  # in place, to save memory
                some = slice(first, first + step)
                values[:, some] = values[order, some]
        arrays[column.name] = values.reshape(-1, *column.shape)
    return frame_set(others.take(order), arrays)


def order_of(table: pa.Table) -> npt.NDArray[np.int64]:
    """The rows sorted by sequence and name, both in natural order."""
    coded = pc.dictionary_encode(table["sequence"]).combine_chunks()
    sequences, codes = coded.dictionary.to_pylist(), coded.indices.to_numpy()
    rank = {sequence: n for n, sequence in enumerate(sorted(sequences, key=natural_key))}
    ranks = np.array([rank[sequence] for sequence in sequences], np.int64)[codes]
    names = pc.replace_substring_regex(table["frame"], "(?s)^.*/", "")
    if len(pc.unique(pc.replace_substring_regex(names, "[0-9]", "0"))) == 1:
        by_name = np.asarray(pc.sort_indices(names)).astype(np.int64)  # by character, faster
    else:
        keys = [natural_key(name) for name in names.to_pylist()]
        by_name = np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)
    return by_name[np.argsort(ranks[by_name], kind="stable")]


def frame_set(table: pa.Table, descriptors: Mapping[str, npt.NDArray[Any]]) -> FrameSet:
    """The frames of a table with `FRAME_SET_COLUMNS`, and their descriptors by column."""
    import torch

    return FrameSet(
        frames=tuple(table["frame"].to_pylist()),
        sequences=tuple(pc.dictionary_encode(table["sequence"]).to_pylist()),
        channels={name: torch.from_numpy(values) for name, values in descriptors.items()},
        poses=np.stack([table[axis].to_numpy() for axis in POSE], axis=1),
        stamps=table["stamp"].to_numpy(),
        empty=table["empty"].to_numpy(),
    )
