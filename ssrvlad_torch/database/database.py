"""A database of descriptors on disk: a Lance table (https://lance.org) with one row per frame.

Every change is one commit and makes a new version; a reader keeps the version that it opened."""

from __future__ import annotations

import dataclasses
import os
import re
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from ..channels import LABEL_SHAPES, Column
from ..config import SSRVLADConfig
from ..files import is_uri
from ..taxonomy import LabelSpace
from . import engine, rows
from .frames import FrameRecord, FrameSet, require_list

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import FragmentMetadata

    from ..recognition.matching import Vectors

    Descriptors = Vectors | Mapping[str, Vectors]

Frames = Sequence[FrameRecord | str]
Check = Callable[[rows.StoredRecords], None]
_REMAINS = {"_transactions", "_versions", "data"}
"""What an interrupted `Database.create` leaves."""


class Database:
    """Descriptors of one fingerprint on disk. Use `create` or `open`.

    Several processes and threads may write at once: changes are committed one after another.
    Methods that write raise ValueError if the database was opened at a version, and OSError if the
    disk failed; the database is then unchanged. In a process that was forked after a database was
    used, methods raise RuntimeError.

    Attributes:
        path: the folder, or the URI of an object store, for example ``s3://bucket/town``.
        version: number of the version that is read; every change has another.
        columns: of the descriptors of every frame, one for each channel.
        origins: of label maps by key, see `FrameRecord.origin`.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.database.database import Database
        >>> database = Database.create("town.ssrdb", width=3)
        >>> database.append(["morning/000001"], torch.eye(3)[:1])
        >>> len(database)
        1
    """

    def __init__(
        self, path: str, table: LanceDataset | None = None, read_only: bool = False
    ) -> None:
        if table is None:
            raise ValueError(f"expected Database.open({path!r}), got Database({path!r})")
        self.path, self._read_only, self._lock = path, read_only, threading.RLock()
        self._use(table)
        self._checked = self.version

    def _use(self, table: LanceDataset) -> None:
        self._config, self.columns, self.origins = rows.metadata_of(table.schema, self.path)
        self._table, self.version = table, int(table.version)

    @staticmethod
    def exists(path: str | Path) -> bool:
        """Whether a database is at ``path``; what is no path, and a URI that has lost a slash, as a
        `Path` does, are a ValueError."""
        if not isinstance(path, (str, os.PathLike)):
            raise ValueError(f"expected the folder or URI of a database, got {path!r}")
        if any(Path(path, "_versions").glob("*.manifest")):
            return True
        if re.match("[A-Za-z][A-Za-z0-9+.-]+:/(?!/)", str(path)):
            raise ValueError(f"expected a URI with two slashes, as a str and no Path, got {path!r}")
        with suppress(OSError):
            if is_uri(str(path)):
                engine.open_table(str(path))
                return True
        return False

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: SSRVLADConfig | None = None,
        width: int | None = None,
        columns: Sequence[Column] = (),
    ) -> Database:
        """Creates an empty database in a new or empty folder, or at a URI; a folder in use is a
        ValueError. ``config`` has the settings of the descriptors of label maps, the first channel;
        a custom label space is stored with them. ``width`` is instead of it the length of
        descriptors that another method makes; ``columns`` are of further channels, with names that
        no other column has."""
        if (config is None) == (width is None):
            raise ValueError("expected the config of the descriptors, or the width of custom ones")
        if width is not None and (not hasattr(width, "__index__") or width < 1):
            raise ValueError(f"width: expected an integer from 1, got {width!r}")
        if config:
            first = Column(LABEL_SHAPES, config.fingerprint, (config.length,))
        else:
            first = Column(rows.DESCRIPTOR, "", (int(width or 0),))
        schema = rows.new_schema(config, [first, *columns])
        if cls.exists(path):
            raise ValueError(f"{path} is a database already")
        folder = Path(path)
        foreign = folder.is_dir() and {entry.name for entry in folder.iterdir()} - _REMAINS
        if foreign or folder.is_file():
            raise ValueError(f"{path} exists and is not a database; expected a new or empty folder")
        return cls(str(path), engine.create(str(path), schema))

    @classmethod
    def open(cls, path: str | Path, version: int | None = None) -> Database:
        """Opens a database; at a ``version`` of `history` read-only, else the newest. One that does
        not exist, was made by another version of the method, or cannot be read is a ValueError,
        which says which version can be read."""
        text, folder = str(path), Path(path)
        if not cls.exists(path) and not is_uri(text):
            problem = "is not a database" if folder.exists() else "does not exist"
            raise ValueError(f"{text} {problem}; expected a folder that ssrvlad encode wrote")
        if folder.is_dir() and (links := [*filter(Path.is_symlink, folder.iterdir())]):
            raise ValueError(f"{links[0]} is a link; expected a folder of the database")
        try:
            table = engine.open_table(text, version)
        except OSError as error:
            if isinstance(error, engine.PanicError) or "too many open files" in str(error).lower():
                raise
            raise ValueError(engine.unreadable(text, version, error)) from error
        return cls(text, table, read_only=version is not None)

    @classmethod
    def open_or_create(
        cls, path: str | Path, config: SSRVLADConfig, columns: Sequence[Column] = ()
    ) -> Database:
        """Opens a database of these settings, see `require`, or creates it if there is none."""
        try:
            if not cls.exists(path):
                return cls.create(path, config, columns=columns)
        except (OSError, ValueError):
            if not cls.exists(path):  # not created by another process meanwhile
                raise
        database = cls.open(path)
        database.require(config, columns)
        return database

    def __len__(self) -> int:
        with self.reading():
            return int(self._table.count_rows())

    def __bool__(self) -> bool:
        return True  # even without frames

    def __repr__(self) -> str:
        names = " and ".join(column.name for column in self.columns)
        return f"<Database {self.path}: {len(self)} frames by {names}, version {self.version}>"

    @property
    def fingerprint(self) -> str:
        """Of the first channel; empty if the descriptors are custom."""
        return self.columns[0].fingerprint

    @property
    def config(self) -> SSRVLADConfig:
        """The settings of all descriptors; a ValueError if they are custom."""
        if self._config is None:
            raise ValueError(f"{self.path} holds custom descriptors, without settings")
        return self._config

    def label_spaces(self) -> list[LabelSpace]:
        """The label spaces of `used_origins`, each once."""
        spaces = dict[str, LabelSpace]()
        for origin in self.used_origins():
            if space := origin.label_space:
                spaces.setdefault(space.digest, space)
        return [*spaces.values()]

    def used_origins(self) -> list[rows.Origin]:
        """The origins that frames have; all of an empty database."""
        keys = self._columns(["origin"])["origin"].unique().to_pylist() or self.origins
        return [self.origins[key] for key in keys if key in self.origins]

    def require(self, config: SSRVLADConfig, columns: Sequence[Column] = ()) -> None:
        """Raises a ValueError if the descriptors were made with other settings, which are shown
        with both fingerprints, or if frames lack one of these further columns."""
        for column in columns:
            if column not in self.columns:
                names = ", ".join(f"{c.name}, {c.fingerprint}" for c in self.columns[1:]) or "none"
                raise ValueError(
                    f"{self.path} has no descriptors by {column.name}, {column.fingerprint}, but "
                    f"{names}: they can only be added when a database is created"
                )
        if config.fingerprint == self.fingerprint:
            return
        stored, expected = self.config.to_dict(), config.to_dict()
        differing = [
            f"{name} {stored[name]} there and {expected[name]} here"
            for name in stored
            if name != "labels_as" and stored[name] != expected[name]
        ]
        raise ValueError(
            f"{self.path} has fingerprint {self.fingerprint} ({self.config.preset}), these "
            f"settings have {config.fingerprint} ({config.preset}): {'; '.join(differing)}"
        )

    def known(self) -> rows.StoredRecords:
        """The records of all frames."""
        return rows.StoredRecords(self._columns(rows.RECORD_COLUMNS))

    def folders(self) -> set[tuple[str, str]]:
        """See `rows.folders_of`."""
        return rows.folders_of(self._columns(["signature", "sequence"]))

    def placed(self) -> tuple[FrameSet, npt.NDArray[np.int64]]:
        """All frames as from `load`, but without descriptors and not verified, and ``(R,)`` the
        place of each in the table."""
        return rows.in_natural_order(self._columns(rows.FRAME_SET_COLUMNS))

    def load(self) -> FrameSet:
        """Loads all frames into memory and verifies every byte; damage is a ValueError that names
        the file."""
        frames, order = self.placed()
        if twice := len(order) - len(set(frames.frames)):
            raise ValueError(f"{self.path} is damaged: it holds {twice} frames twice")
        channels = rows.load_descriptors(self._table, self.columns, order)
        return dataclasses.replace(frames, channels=channels)

    def damage(self, progress: Callable[[int], object] = lambda _: None) -> list[rows.Damage]:
        """All damage; ``progress`` is called with the number of frames read since the last call."""
        damage = list[rows.Damage]()
        for batch in rows.read_rows(self.table().get_fragments(), damage):
            progress(len(batch))
        return damage

    def table(self) -> LanceDataset:
        """The version that is read, as a table of Lance, for what this class does not offer."""
        engine.lance()
        return self._table

    def history(self) -> list[engine.Version]:
        """The versions that are stored, the oldest first."""
        with self.reading():
            return engine.history(self.table())

    def info(self) -> dict[str, Any]:
        """Counts and settings of the database, ready for JSON; rows are not verified."""
        table = self._columns(["sequence", "x", "empty", "origin"])
        counts, config = Counter(table["origin"].to_pylist()), self._config
        origins = {key: self.origins.get(key, rows.Origin()) for key in counts}
        return {
            "frames": len(table),
            "sequences": dict(Counter(table["sequence"].to_pylist())),
            "empty": int(np.count_nonzero(table["empty"].to_numpy())),
            "with_pose": int(np.count_nonzero(~np.isnan(table["x"].to_numpy()))),
            "label_spaces": {str(origins[key]): count for key, count in counts.items()},
            "width": self.columns[0].shape[0],
            "preset": config and config.preset,
            "fingerprint": self.fingerprint,
            "channels": {column.name: column.fingerprint for column in self.columns},
            "config": config and {**config.to_dict(), "labels_as": config.labels_name},
            "version": self.version,
        }

    def add_origin(
        self, label_space: LabelSpace | None, segmenter: str = "", network: str = ""
    ) -> str:
        """Stores an origin of label maps, see `Origin`, in one commit, unless it is stored already.
        Returns its key, for `FrameRecord.origin`."""
        origin = rows.Origin(label_space, segmenter, network)
        if origin.key not in self.origins:
            self._apply(partial(engine.add_metadata, entries=origin.to_entry()))
        return origin.key

    def append(self, frames: Frames, descriptors: Descriptors) -> None:
        """Adds new frames in one commit, flushed to disk when this returns. ``frames`` are N
        records, or only ids, see `FrameRecord.of_id`; ``descriptors`` are ``(N, *shape)`` for each
        column by its name, or of the only one, raw. A wrong shape, a row that is not finite or
        whose length does not fit float32, and an id that is invalid or stored are a ValueError."""
        self._change("append", *self._written(frames, descriptors))

    def merge(self, frames: Frames, descriptors: Descriptors, check: Check | None = None) -> None:
        """Adds frames and replaces those with the same ids, in one commit. A replaced frame keeps
        its arrival if the new record has none. Arguments and errors as for `append`; ``check`` gets
        the records of the version that is changed, if others may have added frames since this
        object was made or changed frames; an error of it ends the change."""
        stored = self._columns(["frame", "arrival"], engine.open_table(self.path)).to_pydict()
        arrivals = dict(zip(*stored.values(), strict=True))
        records = _records(frames)
        for row, record in enumerate(records):
            if record.arrival < 0:
                records[row] = record._replace(arrival=arrivals.get(record.frame, -1))
        self._change("merge", *self._written(records, descriptors), check)

    def remove(self, frames: Collection[str]) -> None:
        """Removes frames by their ids, in one commit; ignores ids that are not in the database."""
        require_list(frames)
        self._change("remove", sorted(set(frames)))

    def _written(
        self, frames: Frames, descriptors: Descriptors
    ) -> tuple[list[str], list[FragmentMetadata]]:
        """The ids of rows, and their files, to which no version refers yet; errors of `append`."""
        self._require_writable()
        records = _records(frames)
        names = [column.name for column in self.columns]
        arrays = descriptors if isinstance(descriptors, Mapping) else {names[0]: descriptors}
        if arrays.keys() != set(names):
            held, got = ", ".join(names), ", ".join(arrays)
            raise ValueError(f"{self.path} holds {held} of every frame, got {got}")
        rows.check_records(records, self.origins)
        table = rows.to_table(records, arrays, self.columns)
        with engine.lance_errors(OSError, f"{self.path} cannot be written"):
            fragments = engine.write_fragments(self.table(), table) if records else []
        return table["frame"].to_pylist(), fragments

    def _change(
        self,
        verb: Literal["append", "merge", "remove"],
        frames: Sequence[str],
        fragments: Sequence[FragmentMetadata] = (),
        check: Check | None = None,
    ) -> None:
        """Appends rows; or merges them, which replaces frames; or removes frames."""
        ids = pa.table({"frame": pa.array(frames, pa.string())})

        def plan(table: LanceDataset) -> Any:
            if check and table.version != self._checked:
                check(rows.StoredRecords(self._columns(rows.RECORD_COLUMNS, table)))
            stored = ids.filter(pc.is_in(ids["frame"], self._columns(["frame"], table)["frame"]))
            if verb == "append" and len(stored):
                raise ValueError(f"frame {stored['frame'][0].as_py()!r} is in {self.path} already")
            if verb == "remove" and not len(stored):
                return None
            return engine.replacement(table, ids if len(stored) else None, fragments)

        if len(ids):
            self._apply(partial(engine.commit, plan=plan, message=f"{verb} {len(ids)} frames"))
            self._checked = self.version

    def drop_damaged(self) -> list[rows.Damage]:
        """Drops damaged rows, and those after a place that cannot be read in the same file, in one
        commit, and returns the damage."""
        damage = list[rows.Damage]()
        plan = partial(rows.without_damage, damage=damage)
        self._apply(partial(engine.commit, plan=plan, message="drop damaged rows"))
        return damage

    def compact(self, keep_days: float = 14) -> None:
        """Joins small files, and deletes versions older than ``keep_days`` with the files that only
        they need; reading such a version is then a ValueError."""
        self._apply(engine.compact)
        self._apply(partial(engine.clean, keep=timedelta(days=keep_days)))

    def _apply(self, change: Callable[[LanceDataset], LanceDataset]) -> None:
        """Changes the newest version; see `engine.change_table`. An interrupt may come after the
        commit: then this object reads what is stored."""
        self._require_writable()
        with self._lock:
            try:
                self._use(engine.change_table(self.path, change))
            except BaseException as error:
                if not isinstance(error, Exception):
                    self._use(engine.open_table(self.path))
                raise

    def _require_writable(self) -> None:
        engine.lance()  # refuses a fork, where a lock of another thread may never be released
        if self._read_only:
            raise ValueError(f"{self.path} was opened as of version {self.version}, read-only")

    def _columns(self, names: list[str], table: LanceDataset | None = None) -> pa.Table:
        """Columns of the rows in the order in which they are stored."""
        with self.reading():
            read = self._table if table is None else table
            return read.to_table(columns=names, scan_in_order=True)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Turns an error while `table` is read into a ValueError that says whether the database is
        damaged, or this version was deleted since."""
        try:
            with engine.lance_errors(ValueError, f"{self.path} is damaged"):
                yield
        except ValueError as error:
            if self.version in engine.local_versions(self.path) or is_uri(self.path):
                raise
            raise ValueError(
                f"version {self.version} of {self.path} was deleted since: open it again"
            ) from error


def _records(frames: Frames) -> list[FrameRecord]:
    require_list(frames)
    return [FrameRecord.of_id(f) if isinstance(f, str) else f for f in frames]
