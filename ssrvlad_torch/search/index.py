"""The index of a large map on disk: a code of every frame, by which likely rows are found.

It stands in a folder of the database, as a table of Lance and a file of what makes codes. A code
belongs to the checksum of its row: what changes is coded again, and nothing else."""

from __future__ import annotations

import json
import math
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch
from torch import Tensor

from ..channels import Column
from ..database import engine
from ..database.database import Database
from ..database.frames import FrameSet
from ..database.rows import checksums, intact, matrix
from ..files import is_uri, path_within, read_npz, replacing
from .codes import Coder

if TYPE_CHECKING:
    from lance import LanceDataset

Keys = npt.NDArray[np.uint64]
Codes = Mapping[str, npt.NDArray[np.int8]]

FOLDER, _CODES, _LEARNT, _VERSION = "_index", "codes", "learnt.npz", 1
LEAST_ROWS = 20_000
"""Maps of fewer frames are loaded and searched in memory, see docs/evaluation/speed.md."""

_SAMPLE, _SAMPLE_BYTES, _GROWTH = 4096, 1 << 27, 4
"""Rows and bytes, at most, that codes are learnt from; a map that has grown so many times is learnt
anew."""
_READ, _WRITE = 1 << 12, 1 << 16
"""Rows that are read, and codes that are written at once."""


class Report(NamedTuple):
    """The frames that `build` indexed now and in all, the bytes of the index, and the seconds."""

    new: int
    frames: int
    bytes: int
    seconds: float


class MapRows(NamedTuple):
    """The rows of a database in natural order: the frames without descriptors, the place of each in
    the table ``(R,)``, and their checksums ``(R,)``."""

    frames: FrameSet
    stored: npt.NDArray[np.int64]
    keys: Keys

    @classmethod
    def of(cls, database: Database) -> Self:
        """Those of the version that is read; no frames are a ValueError."""
        frames, stored = database.placed()
        if not len(frames):
            raise ValueError(f"{database.path} holds no frames yet")
        table = database.table().to_table(columns=["checksum"], scan_in_order=True)
        return cls(frames, stored, table["checksum"].to_numpy()[stored])


def build(database: Database) -> Report:
    """Indexes the frames of a database that its index lacks; all if there is none, if it is damaged
    or of other channels, if the map has grown much since, or if most codes are of no frame. A
    database that is damaged, in an object store, or without frames is a ValueError, an index that
    cannot be written an OSError."""
    if is_uri(database.path):
        raise ValueError(f"an index needs a folder on this machine, {database.path} is a URI")
    began, rows = time.perf_counter(), MapRows.of(database)
    folder = _folder(database)
    try:
        index = Index(database, rows)
        is_old = bool(damaged(database)) or len(rows.keys) > _GROWTH * index.learnt_of
        is_old = is_old or index.unused > len(rows.keys)
    except ValueError:
        is_old = True
    if is_old:
        _learn(database, rows)
        index = Index(database, rows)
    new = index.add()
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return Report(new, len(rows.keys), size, time.perf_counter() - began)


def grow(database: Database) -> None:
    """Indexes the frames that the index of a database lacks, if it has one."""
    if is_indexed(database) and len(database):
        build(database)


def is_indexed(database: Database) -> bool:
    """Whether a database has an index, in whatever state."""
    return not is_uri(database.path) and Path(database.path, FOLDER).exists()


def _folder(database: Database) -> Path:
    """The folder of the index; a link is a ValueError."""
    return path_within(Path(database.path), FOLDER, FOLDER)


def damaged(database: Database) -> list[str]:
    """What of the index of a database is not as it was written, below its folder; nothing without
    an index."""
    if not is_indexed(database):
        return []
    folder, names = _folder(database), list[str]()
    try:
        with engine.lance_errors(ValueError):
            batches = engine.open_table(str(folder / _CODES)).to_batches(batch_size=_READ)
            if not all(intact(batch).all() for batch in batches):
                raise ValueError
    except (OSError, ValueError):
        names.append(f"{FOLDER}/{_CODES}")
    try:
        read_npz(folder / _LEARNT)
    except (OSError, ValueError):
        names.append(f"{FOLDER}/{_LEARNT}")
    return names


class Index:
    """The index of a database, opened: the rows of the map, coders by channel, the number of rows
    that the map had when the codes were learnt, and that of codes that no row has."""

    def __init__(self, database: Database, rows: MapRows) -> None:
        """Raises a ValueError in one line if there is no index, or one that is damaged or of other
        channels."""
        path, folder = database.path, _folder(database)
        if not is_indexed(database):
            raise ValueError(f"{path} has no index; ssrvlad db index builds one")
        self.rows, self._database = rows, database
        try:
            learnt = read_npz(folder / _LEARNT)
            if learnt["columns"].tobytes() != _described(database.columns):
                raise ValueError
            self.learnt_of = int(learnt["rows"])
            self.coders = {
                name: Coder(*(torch.from_numpy(learnt[f"{name}.{kind}"]) for kind in Coder._fields))
                for name, *_ in database.columns
            }
            self._table = engine.open_table(str(folder / _CODES))
            self._places = _places(self._table, rows.keys)
            self.unused = self._table.count_rows() - int((self._places >= 0).sum())
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(
                f"the index of {path} is damaged, or of other channels or another version; "
                "ssrvlad db index builds it anew"
            ) from error

    def codes(self) -> Codes:
        """``(R, length)`` by channel, in the order of the map; rows without are a ValueError."""
        path, lacking = self._database.path, int((self._places < 0).sum())
        if lacking:
            raise ValueError(
                f"the index of {path} lacks {lacking} of {len(self._places)} frames; ssrvlad db "
                "index adds them"
            )
        with engine.lance_errors(ValueError, f"the index of {path} is damaged"):
            table = self._table.to_table(scan_in_order=True)
        if not intact(table).all():
            raise ValueError(f"the index of {path} is damaged; ssrvlad db index builds it anew")
        return {name: matrix(table[name])[self._places] for name in self.coders}

    def add(self) -> int:
        """Codes the rows that lack a code, in one commit, and returns how many."""
        new, fragments = np.flatnonzero(self._places < 0), list[Any]()
        for first in range(0, len(new), _WRITE):
            table = pa.Table.from_batches(self._coded(new[first : first + _WRITE]))
            with engine.lance_errors(OSError, f"{self._table.uri} cannot be written"):
                fragments += engine.write_fragments(self._table, table)
        if fragments:
            plan = partial(engine.replacement, ids=None, added=fragments)
            commit = partial(engine.commit, plan=plan, message=f"index {len(new)} frames")
            engine.change_table(self._table.uri, commit)
        return len(new)

    def _coded(self, rows: npt.NDArray[np.int64]) -> Iterator[pa.RecordBatch]:
        columns = self._database.columns
        for first in range(0, len(rows), _READ):
            block = rows[first : first + _READ]
            read = read_rows(self._database, self.rows.stored[block], columns, verified=True)
            codes = {name: coder.codes(read[name]) for name, coder in self.coders.items()}
            yield _batch(self.rows.keys[block], codes)


def _learn(database: Database, rows: MapRows) -> None:
    """Begins an index: learns codes from a sample of the rows."""
    folder, columns = _folder(database), database.columns
    size = sum(math.prod(column.shape) * np.dtype(column.dtype).itemsize for column in columns)
    count = min(len(rows.keys), _SAMPLE, max(1, _SAMPLE_BYTES // size))
    chosen = np.random.default_rng(0).choice(rows.stored, count, replace=False)
    sample = read_rows(database, np.sort(chosen), columns, verified=True)
    shutil.rmtree(path_within(folder, _CODES, _CODES), ignore_errors=True)
    path_within(folder, _LEARNT, re.escape(_LEARNT)).unlink(missing_ok=True)
    folder.mkdir(exist_ok=True)
    about = np.frombuffer(_described(columns), np.uint8)
    learnt: dict[str, Any] = {"rows": np.array(len(rows.keys)), "columns": about}
    codes = {}
    for name, values in sample.items():
        coder = Coder.learn(values)
        codes[name] = coder.codes(values[:0])
        learnt |= {f"{name}.{field}": array.numpy() for field, array in coder._asdict().items()}
    engine.create(str(folder / _CODES), _batch(rows.keys[:0], codes).schema)
    with replacing(folder / _LEARNT) as path, path.open("wb") as stream:
        np.savez(stream, **learnt)


def read_rows(
    database: Database,
    rows: npt.NDArray[np.int64],
    columns: Sequence[Column],
    verified: bool = False,
) -> dict[str, Tensor]:
    """The descriptors ``(N, *shape)`` of rows, by their places in the table, by channel;
    ``verified`` checks their bytes. Damage is a ValueError."""
    table, path = database.table(), database.path
    names = table.schema.names if verified else [column.name for column in columns]
    with database.reading():
        read = table.take(rows.tolist(), columns=names)
    if verified and not intact(read).all():
        raise ValueError(f"{path} is damaged; ssrvlad db verify shows where")
    return {
        column.name: torch.from_numpy(matrix(read[column.name]).copy()).view(-1, *column.shape)
        for column in columns
    }


def _batch(keys: Keys, codes: Codes) -> pa.RecordBatch:
    """Codes ``(N, length)`` by channel as rows, with their keys and checksums."""
    columns = {"key": pa.array(keys)}
    for name, numbers in codes.items():
        flat = pa.array(numbers.ravel())
        columns[name] = pa.FixedSizeListArray.from_arrays(flat, numbers.shape[1])
    columns["checksum"] = pa.array(checksums(pa.record_batch(columns)))
    kinds = [pa.field(name, column.type, nullable=False) for name, column in columns.items()]
    return pa.record_batch([*columns.values()], schema=pa.schema(kinds))


def _described(columns: Sequence[Column]) -> bytes:
    return json.dumps([_VERSION, columns]).encode()


def _places(table: LanceDataset, keys: Keys) -> npt.NDArray[np.int64]:
    """``(N,)``, the places of rows in a table by their keys; -1 for none."""
    stored = table.to_table(columns=["key"], scan_in_order=True)["key"].to_numpy()
    if not len(stored):
        return np.full(len(keys), -1)
    order = np.argsort(stored)
    places = order[np.searchsorted(stored, keys, sorter=order).clip(max=len(stored) - 1)]
    places_of_keys: npt.NDArray[np.int64] = np.where(stored[places] == keys, places, -1)
    return places_of_keys
