"""Rows of a database's table as a `FrameSet`, in the order of a person."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from .frames import FrameSet, natural_key
from .rows import DESCRIPTOR, POSE, Arrays

OF_A_SET = ["frame", "sequence", *POSE, "stamp", "empty"]
"""Columns of a table that `frame_set` wants, beside descriptors."""

_COLUMNS_AT_ONCE = 16


def order_of(table: pa.Table) -> npt.NDArray[np.int64]:
    """Rows by sequence and name as a person would sort them."""
    coded = pc.dictionary_encode(table["sequence"]).combine_chunks()
    sequences, codes = coded.dictionary.to_pylist(), coded.indices.to_numpy()
    rank = {sequence: n for n, sequence in enumerate(sorted(sequences, key=natural_key))}
    ranks = np.array([rank[sequence] for sequence in sequences], np.int64)[codes]
    by_name = _by_name(pc.replace_substring_regex(table["frame"], "(?s)^.*/", ""))
    return by_name[np.argsort(ranks[by_name], kind="stable")]


def _by_name(names: pa.ChunkedArray) -> npt.NDArray[np.int64]:
    """Names in natural order. Where they differ in digits only, that is the order of characters."""
    if len(pc.unique(pc.replace_substring_regex(names, "[0-9]", "0"))) == 1:
        return np.asarray(pc.sort_indices(names)).astype(np.int64)
    keys = [natural_key(name) for name in names.to_pylist()]
    return np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)


def in_order(
    descriptors: npt.NDArray[np.float32], order: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Rows in another order, in place: a million of them need no second place."""
    if (order[1:] > order[:-1]).all():
        return descriptors
    for first in range(0, descriptors.shape[1], _COLUMNS_AT_ONCE):
        some = slice(first, first + _COLUMNS_AT_ONCE)
        descriptors[:, some] = descriptors[order, some]
    return descriptors


def frame_set(table: pa.Table, descriptors: Arrays) -> FrameSet:
    """The frames of rows with the columns `OF_A_SET`, and their descriptors by column."""
    import torch

    beside = {name: torch.from_numpy(values) for name, values in descriptors.items()}
    return FrameSet(
        frames=tuple(table["frame"].to_pylist()),
        sequences=tuple(pc.dictionary_encode(table["sequence"]).to_pylist()),
        descriptors=beside.pop(DESCRIPTOR),
        poses=np.stack([table[axis].to_numpy() for axis in POSE], axis=1),
        stamps=table["stamp"].to_numpy(),
        empty=table["empty"].to_numpy(),
        beside=beside,
    )
