"""A database of descriptors on disk: Parquet parts and a manifest.

A database is a folder with ``manifest.json`` and ``part-000000.parquet``, ``part-000001.parquet``
and so on. A part holds one row a frame and is never changed once written. The manifest names the
parts that count, so a part that a crash left behind is invisible. Both are written under a
temporary name, flushed to the disk and renamed.

A frame has one row. To replace or remove rows is to write the parts that held them anew under new
numbers, and to name those in one new manifest. What no manifest names is deleted by the next
writer, not at once, so that one who reads by the manifest of a moment ago finds its parts.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import torch
from numpy.lib.format import open_memmap
from torch import Tensor

from ..config import SSRVLADConfig
from ..recognition.matching import temporal_sum
from .storage.manifest import MANIFEST, Manifest, is_part_name, read_manifest
from .storage.parts import (
    Damage,
    FrameRecord,
    Part,
    matrix,
    read_intact,
    read_part,
    schema,
    to_table,
    write_part,
)

__all__ = ["Damage", "Database", "FrameRecord", "FrameSet", "natural_key"]

DERIVED = "search-"
"""What the names of files start with that are derived from a database and lie in its folder."""

Array = npt.NDArray[Any]

_LOCK = "lock"
_POSE = ["x", "y", "heading"]
_OF_FILES = ["digest", "stamp", *_POSE]
_HALF_DONE = (f".{MANIFEST}.", ".part-", f".{DERIVED}")


@dataclass(frozen=True)
class FrameSet:
    """Frames in memory, those of a sequence one after another in order.

    Attributes:
        frames: ids, ``<sequence>/<name>``.
        sequences: the sequence of each frame.
        descriptors: ``(R, D)`` float32, of references after Eq. 3 if it was asked for; float16 if
            that was asked for.
        poses: ``(R, 3)`` float64, x and y in metres and heading in radians, NaN where unknown.
        empty: ``(R,)`` bool, frames whose own descriptor is zero; they match nothing.
    """

    frames: tuple[str, ...]
    sequences: tuple[str, ...]
    descriptors: Tensor
    poses: npt.NDArray[np.float64]
    empty: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class KnownFrames:
    """The frames of a database and what tells whether their files have changed.

    Attributes:
        rows: row of each frame by its id, in the order of addition.
        columns: digest, stamp and pose of each row, in chunks as they were read.
    """

    rows: dict[str, int]
    columns: pa.Table

    @property
    def digests(self) -> pa.ChunkedArray:
        """Of each row's label map, in hex."""
        return self.columns["digest"]

    @property
    def stamps(self) -> npt.NDArray[np.int64]:
        """``(R,)`` int64, of each row's file."""
        stamps: npt.NDArray[np.int64] = self.columns["stamp"].to_numpy()
        return stamps

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(R, 3)`` float64, as in a `FrameSet`."""
        return _poses(self.columns)


class Database:
    """Descriptors of one fingerprint on disk.

    Use `create`, `open` or `open_or_create`.

    Attributes:
        path: the folder.
        damage: what was left out so far, if it was opened to read on past damage.
    """

    def __init__(self, path: Path, manifest: Manifest, skip_damaged: bool = False) -> None:
        self.path = path
        self.damage: list[Damage] = []
        self._manifest = manifest
        self._skip_damaged = skip_damaged
        self._lock: IO[str] | None = None
        self._known: tuple[tuple[Part, ...], KnownFrames] | None = None

    @staticmethod
    def exists(path: str | Path) -> bool:
        """Whether a folder is a database."""
        return (Path(path) / MANIFEST).is_file()

    @classmethod
    def create(cls, path: str | Path, config: SSRVLADConfig) -> Database:
        """A new, empty database.

        Raises:
            ValueError: something is there: a file, or a folder that is not empty.
            OSError: it cannot be written.
        """
        path = Path(path)
        if cls.exists(path):
            raise ValueError(f"{path} is a database already")
        if path.is_file() or (path.is_dir() and not _is_vacant(path)):
            raise ValueError(f"{path} is there and is no database; wanted a new or an empty folder")
        path.mkdir(parents=True, exist_ok=True)
        with _locked(path):
            if cls.exists(path):
                raise ValueError(f"{path} is a database already")
            Manifest(config).write(path)
        return cls(path, Manifest(config))

    @classmethod
    def open(cls, path: str | Path, skip_damaged: bool = False) -> Database:
        """An existing database.

        Args:
            path: the folder.
            skip_damaged: read on where a part or the manifest is damaged: row groups that are
                not whole are left out and noted in `damage`. Such a database is not written to,
                but for `drop_damaged`.

        Raises:
            ValueError: the folder is no database, its manifest is damaged or of another format, or
                its settings give other descriptors in this version of the method.
        """
        path = Path(path)
        return cls(path, read_manifest(path, skip_damaged), skip_damaged)

    @classmethod
    def open_or_create(cls, path: str | Path, config: SSRVLADConfig) -> Database:
        """The database at ``path``, new if there is none.

        Raises:
            ValueError: the database there has another fingerprint; both are shown.
        """
        path = Path(path)
        if not cls.exists(path):
            return cls.create(path, config)
        database = cls.open(path)
        database.require(config)
        return database

    @property
    def config(self) -> SSRVLADConfig:
        """The settings of every descriptor; ``labels_as`` is that of the first frames."""
        return self._manifest.config

    @property
    def fingerprint(self) -> str:
        """Fingerprint of every descriptor in the database."""
        return self.config.fingerprint

    @property
    def content(self) -> str:
        """64 hex digits that are others whenever a frame was added, replaced or removed."""
        return self._manifest.checksum

    def __len__(self) -> int:
        return sum(part.rows for part in self._manifest.parts)

    def require(self, config: SSRVLADConfig) -> None:
        """Refuses descriptors made with other settings.

        Raises:
            ValueError: shows both fingerprints and the settings that differ.
        """
        if config.fingerprint == self.fingerprint:
            return
        mine, theirs = self.config.to_dict(), config.to_dict()
        differing = [
            f"{name} {mine[name]} there and {theirs[name]} here"
            for name in mine
            if name != "labels_as" and mine[name] != theirs[name]
        ]
        raise ValueError(
            f"{self.path} has fingerprint {self.fingerprint} ({self.config.preset}), these "
            f"settings have {config.fingerprint} ({config.preset}): {'; '.join(differing)}"
        )

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Keeps other writers out, sees what they wrote, and deletes what they left half done.

        What writes does this by itself; around several writes it makes them one writer's.

        Raises:
            ValueError: another process is writing, or the database was made anew meanwhile with
                other settings, or it was opened to read on past damage.
            OSError: the folder cannot be written.
        """
        if self._skip_damaged:
            raise ValueError(f"{self.path} is damaged: wanted what is lost dropped before writing")
        with self._alone():
            yield

    @contextmanager
    def _alone(self) -> Iterator[None]:
        if self._lock is not None:
            yield
            return
        with _locked(self.path) as lock:
            current = read_manifest(self.path, self._skip_damaged)
            Database(self.path, current).require(self.config)
            self._manifest, self._lock = current, lock
            try:
                self._sweep()
                yield
            finally:
                self._lock = None

    def let_go(self) -> None:
        """In a process forked while `writing`: gives up its share of the lock."""
        if self._lock is not None:
            self._lock.close()

    def append(self, records: Sequence[FrameRecord], descriptors: Tensor) -> None:
        """Adds frames as one part; they are on the disk when it returns.

        Args:
            records: N frames; ids that are already there are an error.
            descriptors: ``(N, D)`` float32, raw: neither summed over time nor centred.

        Raises:
            ValueError: the numbers do not fit or are not finite, an id is there already, or another
                process is writing.
            OSError: the disk refused; the database is as it was.
        """
        self._check(records, descriptors)
        if not records:
            return
        with self.writing():
            known = self.known().rows
            for record in records:
                if record.frame in known:
                    raise ValueError(f"frame {record.frame!r} is in {self.path} already")
            table = to_table(records, descriptors)
            part = write_part(self.path, self._manifest.name(), table)
            self._commit((*self._manifest.parts, part), new=1)

    def part_name(self, number: int) -> str:
        """Name under which another process writes the part ``number`` after those that are there,
        for `adopt`; valid while `writing`."""
        return self._manifest.name(number)

    def adopt(self, parts: Sequence[Part]) -> int:
        """Adds parts that other processes wrote, in one commit, after reading them.

        Args:
            parts: written by `parts.write_part` in the database's folder, named by `part_name`.

        Returns:
            How many of their frames are empty.

        Raises:
            ValueError: a part is missing or damaged, or a frame is there already.
            OSError: the disk refused; the database is as it was.
        """
        empty = 0
        with self.writing():
            seen = set(self.known().rows)
            for part in parts:
                table = read_part(self.path, part, self.config.length)
                ids = _ids(table)
                repeated = next((frame for frame in ids if frame in seen), None)
                if repeated is not None or len(set(ids)) < len(ids):
                    raise ValueError(f"frame {repeated or ids[0]!r} of {part.file} is there twice")
                seen.update(ids)
                empty += int((~matrix(table["descriptor"], self.config.length).any(axis=1)).sum())
            if parts:
                last = max(int(part.file[5:-8]) for part in parts)
                new = last + 1 - self._manifest.next_part
                self._commit((*self._manifest.parts, *parts), new)
        return empty

    def replace(self, records: Sequence[FrameRecord], descriptors: Tensor) -> None:
        """Puts frames in the place of those with the same ids, all of them or none.

        The parts that hold them are written anew. Arguments and errors as for `append`, but the
        ids must be there.
        """
        self._check(records, descriptors)
        with self.writing():
            known = self.known().rows
            for record in records:
                if record.frame not in known:
                    raise ValueError(f"frame {record.frame!r} is not in {self.path}")
            fresh = to_table(records, descriptors)
            row = {record.frame: number for number, record in enumerate(records)}
            self._rewrite(row, lambda table: _renewed(table, fresh, row))

    def remove(self, frames: Collection[str]) -> None:
        """Removes frames by their ids, all of them or none; ids that are not there are passed over.

        The parts that hold them are written anew without them.

        Raises:
            ValueError: another process is writing, or a part is damaged.
            OSError: the disk refused; the database is as it was.
        """
        gone = set(frames)
        with self.writing():
            self._rewrite(
                gone, lambda table: table.filter(pa.array([f not in gone for f in _ids(table)]))
            )

    def drop_damaged(self) -> list[Damage]:
        """Gives up what is damaged: parts that are not whole are written anew with what is.

        Encoding the same files again then brings back what was lost.

        Returns:
            What was damaged.

        Raises:
            ValueError: the database was not opened with ``skip_damaged``, or another process is
                writing.
            OSError: the disk refused; the database is as it was.
        """
        if not self._skip_damaged:
            raise ValueError(f"{self.path} must be opened with skip_damaged")
        with self._alone():
            self.damage, parts, written = [], list[Part](), list[Part]()
            for part in self._manifest.parts:
                table, damage = read_intact(self.path, part, self.config.length)
                self.damage += damage
                if damage and len(table):
                    name = self._manifest.name(len(written))
                    written.append(write_part(self.path, name, table))
                parts += written[-1:] if damage and len(table) else [] if damage else [part]
            self._commit(tuple(parts), len(written))
            damage, self.damage = self.damage, []
            self._skip_damaged = False
        return damage

    def known(self) -> KnownFrames:
        """The frames that are there; what was read before is not read again."""
        parts = self._manifest.parts
        done, known = self._known or ((), _no_frames())
        if parts[: len(done)] != done:
            done, known = (), _no_frames()
        if len(done) < len(parts):
            columns = ["sequence", "name", *_OF_FILES]
            known = _with(known, [self._read(part, columns) for part in parts[len(done) :]])
        self._known = parts, known
        return known

    def digests(self) -> dict[str, str]:
        """Digest of the label map of every frame, by the frame's id."""
        known = self.known()
        return dict(zip(known.rows, known.digests.to_pylist(), strict=True))

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """The rows as they are stored, checksums verified, in the order of addition.

        Raises:
            ValueError: a part is missing or damaged; the message names it.
        """
        nothing = schema(self.config.length, columns).empty_table()
        return pa.concat_tables([nothing, *self.tables(columns)])

    def tables(self, columns: list[str] | None = None) -> Iterator[pa.Table]:
        """As `table`, a part at a time."""
        for part in self._manifest.parts:
            yield self._read(part, columns)

    def load(self, temporal: int = 0) -> FrameSet:
        """All frames in memory, the descriptors once; beyond them one part at a time.

        Args:
            temporal: t of Eq. 3, frames summed on either side; 0 gives the raw descriptors.

        Raises:
            ValueError: a part is missing or damaged; the message names it.
        """
        return self._load(lambda shape: np.empty(shape, np.float32), temporal)

    def load_into(
        self, allocate: Callable[[tuple[int, int]], npt.NDArray[np.float32]], temporal: int = 0
    ) -> FrameSet:
        """All frames, their descriptors in a matrix of the caller's, for example on the disk.

        Args:
            allocate: gives an ``(R, D)`` float32 array to fill.
            temporal: as for `load`.

        Raises:
            ValueError: as for `load`.
        """
        return self._load(allocate, temporal)

    def frames(self) -> FrameSet:
        """All frames as from `load`, without their descriptors: ``(R, 0)``."""
        return self._load(None, 0)

    def _load(
        self, allocate: Callable[[tuple[int, int]], npt.NDArray[np.float32]] | None, temporal: int
    ) -> FrameSet:
        plain = self.table(["sequence", "name", *_POSE])
        order = _order(plain)
        frames, sequences = _names(plain, order)
        poses = _poses(plain)[order]
        empty = np.zeros(len(order), bool)
        descriptors = np.empty((len(order), 0), np.float32)
        if allocate is not None:
            descriptors = allocate((len(order), self.config.length))
            rank = np.empty_like(order)
            rank[order] = np.arange(len(order))
            self._fill(descriptors, empty, rank)
        values = torch.from_numpy(descriptors)
        if temporal and allocate is not None:
            values = temporal_sum(values, sequences, temporal, out=values)
        return FrameSet(frames, sequences, values, poses, empty)

    def _fill(
        self,
        descriptors: npt.NDArray[np.float32],
        empty: npt.NDArray[np.bool_],
        rank: npt.NDArray[np.int64],
    ) -> None:
        """Reads the descriptors part by part, each row to its place."""
        done = 0
        for part in self._manifest.parts:
            table = self._read(part, None)
            rows = rank[done : done + len(table)]
            values = matrix(table["descriptor"], self.config.length)
            descriptors[rows] = values
            empty[rows] = ~values.any(axis=1)
            done += len(table)

    def _check(self, records: Sequence[FrameRecord], descriptors: Tensor) -> None:
        if descriptors.shape != (len(records), self.config.length):
            raise ValueError(
                f"wanted ({len(records)}, {self.config.length}) descriptors for "
                f"{len(records)} frames, got {tuple(descriptors.shape)}"
            )
        if not bool(torch.isfinite(descriptors).all()):
            raise ValueError("descriptors hold values that are not finite")
        seen: set[str] = set()
        for record in records:
            if record.frame in seen:
                raise ValueError(f"frame {record.frame!r} is in what goes into {self.path} already")
            seen.add(record.frame)

    def _read(self, part: Part, columns: list[str] | None) -> pa.Table:
        if not self._skip_damaged:
            return read_part(self.path, part, self.config.length, columns)
        table, damage = read_intact(self.path, part, self.config.length, columns)
        self.damage += [entry for entry in damage if entry not in self.damage]
        return table

    def _rewrite(self, frames: Iterable[str], change: Callable[[pa.Table], pa.Table]) -> None:
        """Writes the parts that hold some frames anew, in one commit."""
        known, ends = self.known().rows, np.cumsum([part.rows for part in self._manifest.parts])
        rows = [known[frame] for frame in frames if frame in known]
        touched = set(np.searchsorted(ends, rows, side="right").tolist())
        parts, written = list[Part](), 0
        for number, part in enumerate(self._manifest.parts):
            if number not in touched:
                parts.append(part)
                continue
            table = change(self._read(part, None))
            if len(table):
                parts.append(write_part(self.path, self._manifest.name(written), table))
                written += 1
        if touched:
            self._commit(tuple(parts), written)

    def _commit(self, parts: tuple[Part, ...], new: int) -> None:
        manifest = self._manifest.replaced(parts, new)
        manifest.write(self.path)
        self._manifest = manifest

    def _sweep(self) -> None:
        """Deletes what writers that were killed left behind, and what no manifest names."""
        kept = {part.file for part in self._manifest.parts}
        for entry in list(self.path.iterdir()):
            derived = entry.name.startswith(DERIVED)
            stale = derived and not entry.name.startswith(f"{DERIVED}{self.content[:16]}-")
            unnamed = is_part_name(entry.name) and entry.name not in kept
            if stale or unnamed or entry.name.startswith(_HALF_DONE):
                entry.unlink(missing_ok=True)


def mapped_array(file: Path, shape: tuple[int, int], dtype: type = np.float32) -> Array:
    """A new ``.npy`` file, memory-mapped. Its room on the disk is taken at once: where that ran
    out later, the system would end the process.

    Raises:
        OSError: there is no room, or no such folder.
    """
    mapped = open_memmap(file, "w+", dtype, shape)
    with file.open("r+b") as stream:
        os.posix_fallocate(stream.fileno(), 0, file.stat().st_size)
    return mapped


def natural_key(name: str) -> str:
    """Sort key that puts ``frame10`` after ``frame9``, as a person would, ``1`` after ``01``."""
    pieces = (piece for piece in re.split(r"(\d+)", name) if piece)
    return "".join(map(_piece_key, pieces)) + f"\0{name}"


def _piece_key(piece: str) -> str:
    """The end of a name sorts before a number, that before other text; numbers by their size."""
    if piece.isdecimal():
        digits = str(int(piece))
        return f"\1{chr(len(digits))}{digits}"
    return f"\2{piece}\0"


@contextmanager
def _locked(path: Path) -> Iterator[IO[str]]:
    """The lock of a database; it ends with the process, however that ends.

    It is given up at the end, not only closed: a worker that was just forked shares it still.
    """
    with (path / _LOCK).open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            holder = file.read(40).strip()
            raise ValueError(
                f"{path} is being written by another process"
                f"{f' ({holder})' if holder else ''}; wait until it is done"
            ) from error
        file.truncate(0)
        owner = os.getpid()
        file.write(f"process {owner}")
        file.flush()
        try:
            yield file
        finally:
            if os.getpid() == owner:
                fcntl.flock(file, fcntl.LOCK_UN)


def _is_vacant(folder: Path) -> bool:
    """Whether a folder is empty but for what a `Database.create` that was killed leaves behind."""
    return all(
        entry.name == _LOCK or entry.name.startswith(_HALF_DONE) for entry in folder.iterdir()
    )


def _no_frames() -> KnownFrames:
    return KnownFrames({}, schema(1, _OF_FILES).empty_table())


def _with(known: KnownFrames, tables: Sequence[pa.Table]) -> KnownFrames:
    """More frames than those known; their dictionary of rows is shared and grows."""
    ids = (frame for table in tables for frame in _ids(table))
    known.rows.update((frame, row) for row, frame in enumerate(ids, len(known.rows)))
    more = [table.select(_OF_FILES) for table in tables]
    return KnownFrames(known.rows, pa.concat_tables([known.columns, *more]))


def _poses(table: pa.Table) -> npt.NDArray[np.float64]:
    return np.stack([table[axis].to_numpy() for axis in _POSE], axis=1)


def _ids(table: pa.Table) -> list[str]:
    sequences = table["sequence"].cast(pa.string())
    joined: list[str] = pc.binary_join_element_wise(sequences, table["name"], "/").to_pylist()
    return joined


def _renewed(table: pa.Table, fresh: pa.Table, row: dict[str, int]) -> pa.Table:
    """A part's rows, those that have a fresh ``row`` replaced by it."""
    new = np.array([row.get(frame, -1) for frame in _ids(table)], np.int64)
    both = pa.concat_tables([table, fresh]).unify_dictionaries()
    return both.take(pa.array(np.where(new < 0, np.arange(len(table)), len(table) + new)))


def _order(table: pa.Table) -> npt.NDArray[np.int64]:
    """Rows by sequence and name as a person would sort them."""
    sequences, codes = _sequences(table)
    rank = {sequence: n for n, sequence in enumerate(sorted(sequences, key=natural_key))}
    ranks = np.array([rank[sequence] for sequence in sequences], np.int64)[codes]
    keys = [natural_key(name) for name in table["name"].to_pylist()]
    order = sorted(range(len(keys)), key=keys.__getitem__)
    by_name = np.array(order, np.int64)
    return by_name[np.argsort(ranks[by_name], kind="stable")]


def _names(
    table: pa.Table, order: npt.NDArray[np.int64]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Ids and sequences of rows in some order."""
    sequences, codes = _sequences(table)
    ids = _ids(table)
    return tuple(ids[row] for row in order), tuple(sequences[code] for code in codes[order])


def _sequences(table: pa.Table) -> tuple[list[str], npt.NDArray[np.int32]]:
    """The sequences of a table, and which of them each row has."""
    column = table.select(["sequence"]).unify_dictionaries()["sequence"].combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else None
    if column is None:
        return [], np.empty(0, np.int32)
    return column.dictionary.to_pylist(), column.indices.to_numpy()
