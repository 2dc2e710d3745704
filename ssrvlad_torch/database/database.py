"""A database of descriptors on disk: one table of Lance (https://lance.org), a row a frame.

Every change is one commit and makes a new version. Who has opened a version keeps it while others
write. What made the descriptors stands in the table's metadata: the settings and their
fingerprint, what else describes every frame, and each label space and segmenter that a row names
as its origin.
"""

from __future__ import annotations

import dataclasses
import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from ..config import SSRVLADConfig
from ..taxonomy import LabelSpace, label_space_names
from ..taxonomy import label_space as label_space_of
from . import engine
from .frame_sets import OF_A_SET, frame_set, in_order, order_of
from .frames import FrameRecord, FrameSet, Vectors, several
from .metadata import ExtraDescriptor, Meta, Origin
from .reading import Damage, is_damaged, read_intact, read_rows
from .rows import (
    DESCRIPTOR,
    OF_A_RECORD,
    Arrays,
    KnownFrames,
    fitting,
    folders_of,
    matrix,
    schema,
    to_table,
)

if TYPE_CHECKING:
    from lance import LanceDataset


class Version(NamedTuple):
    """One version of a database.

    Attributes:
        version: its number, for ``open``.
        time: when it was made.
        frames: how many frames it holds.
        change: what was done.
    """

    version: int
    time: datetime
    frames: int
    change: str


class Written(NamedTuple):
    """Rows on the disk that do not count yet.

    Attributes:
        fragments: Lance's descriptions of the files, as JSON.
        frames: ids.
    """

    fragments: tuple[str, ...]
    frames: tuple[str, ...]


class Database:
    """Descriptors of one kind on disk. Use `create` or `open`.

    Several processes and threads may write at once: each change is made whole, one after another.

    Attributes:
        path: the folder, or the URI of an object store, for example ``s3://bucket/town``.

    Example:
        >>> database = Database.create("town.ssrdb", width=3)
        >>> database.append(["morning/000001"], torch.eye(3)[:1])
        >>> len(database)
        1
    """

    def __init__(self, path: str, table: LanceDataset, pinned: bool) -> None:
        self.path = path
        self._pinned = pinned
        self._writing = threading.Lock()
        self._settle(table)

    def _settle(self, table: LanceDataset) -> None:
        self._table = table
        self._meta = Meta.of(table.schema.metadata or {}, self.path)

    def __len__(self) -> int:
        return int(self._table.count_rows())

    def __bool__(self) -> bool:
        """True, also without frames."""
        return True

    def __repr__(self) -> str:
        kind = f"fingerprint {self.fingerprint}" if self.fingerprint else "without settings"
        beside = "".join(f" and {one.name}" for one in self.beside)
        return (
            f"<Database {self.path}: {len(self)} frames, descriptors of {self.width}{beside}, "
            f"{kind}, version {self.version}>"
        )

    @staticmethod
    def exists(path: str | Path) -> bool:
        """Whether there is a database; one of an earlier format counts too."""
        if engine.is_local(str(path)):
            versions = Path(path, "_versions").glob("*.manifest")
            return any(versions) or Path(path, "manifest.json").is_file()
        try:
            engine.opened(str(path))
        except OSError:
            return False
        return True

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: SSRVLADConfig | None = None,
        width: int | None = None,
        beside: Sequence[ExtraDescriptor] = (),
    ) -> Database:
        """A new, empty database.

        Args:
            path: a new or an empty folder, or a URI.
            config: the settings of every descriptor, a label space of one's own stored whole;
                without, they are a user's own, of which nothing is claimed.
            width: numbers of a descriptor, where there is no config.
            beside: what else describes every frame.

        Raises:
            ValueError: something is there already, neither config nor width is given, or a name
                beside is that of another column.
            OSError: it cannot be written.
        """
        text = str(path)
        if (config is None) == (width is None):
            raise ValueError("expected the config of the descriptors, or the width of one's own")
        widths = {DESCRIPTOR: config.length if config else width or 0}
        widths |= {one.name: one.width for one in beside}
        columns = schema(widths)
        if len(columns) < len(schema({})) + 1 + len(beside):
            names = ", ".join(one.name for one in beside)
            raise ValueError(f"expected names beside that no column has, each once, got {names}")
        if config and config.labels_as not in label_space_names():
            config = dataclasses.replace(config, labels_as=label_space_of(config.labels_as))
        if cls.exists(text):
            raise ValueError(f"{text} is a database already")
        if engine.is_local(text) and (Path(text).is_file() or _is_used(Path(text))):
            raise ValueError(f"{text} is there and is no database; expected a new or empty folder")
        table = engine.create(text, columns.with_metadata(Meta.to_dict(config, beside)))
        return cls(text, table, pinned=False)

    @classmethod
    def open(cls, path: str | Path, version: int | None = None) -> Database:
        """An existing database.

        Args:
            path: the folder or URI.
            version: one of `history`, which is then only read; without, the newest.

        Raises:
            ValueError: there is none, it is damaged or of an earlier format, or its settings give
                other descriptors in this version of the method. Where only the newest versions
                are damaged the message names the last one that is not; see `go_back`.
        """
        text = str(path)
        if engine.is_local(text) and Path(text, "manifest.json").exists():
            raise ValueError(f"{text} was made by an earlier format of database: encode it again")
        if engine.is_local(text) and not cls.exists(text):
            there = "is not a database" if Path(text).exists() else "does not exist"
            raise ValueError(f"{text} {there}")
        if version is not None and version < 1:
            raise ValueError(f"{text} has no version {version}; the first is 1")
        try:
            table = engine.opened(text, version)
        except OSError as error:
            if version:
                told = f"{text} has no version {version}, or it is damaged"
                raise ValueError(f"{told}: {engine.one_line(error)}") from error
            last, _ = engine.newest_readable(text)
            hint = f"; --as-of {last} reads the version before" if last else ""
            told = f"{text} is damaged or not a database: {engine.one_line(error)}{hint}"
            raise ValueError(told) from error
        return cls(text, table, pinned=version is not None)

    @staticmethod
    def go_back(path: str | Path) -> list[str]:
        """Puts the newest versions aside whose manifests cannot be read, as after a power cut.

        Returns:
            Names of their manifests, now ``damaged-*`` in the database's folder.

        Raises:
            OSError: the disk refused.
        """
        return engine.put_aside(str(path))

    @classmethod
    def open_or_create(
        cls, path: str | Path, config: SSRVLADConfig, beside: Sequence[ExtraDescriptor] = ()
    ) -> Database:
        """The database at ``path``, new if there is none.

        Raises:
            ValueError: as `require`.
        """
        if not cls.exists(path):
            try:
                return cls.create(path, config, beside=beside)
            except (OSError, ValueError):
                if not cls.exists(path):  # or another process made it meanwhile
                    raise
        database = cls.open(path)
        database.require(config, beside)
        return database

    @property
    def version(self) -> int:
        """Number of the version that is read; another one for any other content."""
        return int(self._table.version)

    @property
    def config(self) -> SSRVLADConfig:
        """The settings of every descriptor.

        Raises:
            ValueError: they are a user's own, without settings.
        """
        if self._meta.config is None:
            raise ValueError(f"{self.path} holds descriptors of a user's own, without settings")
        return self._meta.config

    @property
    def fingerprint(self) -> str:
        """Fingerprint of every descriptor, empty for a user's own."""
        return self._meta.config.fingerprint if self._meta.config else ""

    @property
    def width(self) -> int:
        """Numbers of a descriptor."""
        return int(self._table.schema.field(DESCRIPTOR).type.list_size)

    @property
    def beside(self) -> tuple[ExtraDescriptor, ...]:
        """What else describes every frame."""
        return self._meta.beside

    @property
    def _widths(self) -> dict[str, int]:
        return {DESCRIPTOR: self.width, **{one.name: one.width for one in self.beside}}

    @property
    def origins(self) -> dict[str, Origin]:
        """What made the label maps, by the key that stands in a frame's record."""
        return dict(self._meta.origins)

    def label_spaces(self) -> list[LabelSpace]:
        """The label spaces of the frames that are there; without any, of those that were."""
        keys = self._columns(["origin"])["origin"].unique().to_pylist() or list(self._meta.origins)
        spaces = [self._meta.origins.get(key, Origin()).label_space for key in keys]
        return list({space.digest: space for space in spaces if space}.values())

    def require(self, config: SSRVLADConfig, beside: Sequence[ExtraDescriptor] = ()) -> None:
        """Refuses descriptors made with other settings.

        Args:
            config: the settings.
            beside: what must describe every frame besides.

        Raises:
            ValueError: shows both fingerprints and the settings that differ, or what is missing
                beside.
        """
        for one in beside:
            if one not in self.beside:
                raise ValueError(
                    f"{self.path} has no descriptors by {one.name}, {one.fingerprint}: a database "
                    "has them from its first frame on, or never"
                )
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

    def add_origin(
        self, label_space: LabelSpace | None, segmenter: str = "", network: str = ""
    ) -> str:
        """Says what made label maps; in a commit of its own, if the database does not know yet.

        Args:
            label_space: stored whole.
            segmenter: identity of the network, empty for label maps that were there.
            network: name by which it can be opened again.

        Returns:
            The key that stands for it in a `FrameRecord`.
        """
        origin = Origin(label_space, segmenter, network)
        if origin.key in self._meta.origins:
            return origin.key
        self._see_writable()
        with self._writing:
            self._settle(engine.add_metadata(self.path, origin.to_entry()))
        return origin.key

    def append(
        self,
        frames: Sequence[FrameRecord | str],
        descriptors: Vectors,
        beside: Mapping[str, Vectors] | None = None,
    ) -> None:
        """Adds frames; they are on the disk when it returns.

        Args:
            frames: N records, or bare ids, ``<sequence>/<name>`` or a name without ``/``; neither
                is empty or has white space at an end. One that is there already is an error.
            descriptors: ``(N, D)`` float32, raw: neither summed over time nor centred.
            beside: likewise for each name of `beside`.

        Raises:
            ValueError: the numbers do not fit, or float32 cannot measure the length of a row; an
                id is there already, or is no id; or the database was opened at a version.
            OSError: the disk refused; the database is as it was.
        """
        self.adopt([self.write_apart(frames, descriptors, beside)])

    def merge(
        self,
        frames: Sequence[FrameRecord | str],
        descriptors: Vectors,
        beside: Mapping[str, Vectors] | None = None,
    ) -> None:
        """Adds frames, those with ids that are there in the place of these, in one commit.

        Arguments and errors as for `append`.
        """
        self._change([self.write_apart(frames, descriptors, beside)], "merge")

    def remove(self, frames: Collection[str]) -> None:
        """Removes frames by their ids, in one commit; ids that are not there are passed over.

        Raises:
            ValueError: the database was opened at a version, or the ids are one text.
            OSError: the disk refused; the database is as it was.
        """
        self._change([Written((), tuple(sorted(set(several(frames)))))], "remove")

    def write_apart(
        self,
        frames: Sequence[FrameRecord | str],
        descriptors: Vectors,
        beside: Mapping[str, Vectors] | None = None,
    ) -> Written:
        """Writes rows that do not count before they are given to `adopt`, here or elsewhere.

        Arguments as for `append`. What is never adopted is deleted by a later `compact`.
        """
        self._see_writable()
        records = [FrameRecord.of_id(f) if isinstance(f, str) else f for f in several(frames)]
        rows = to_table(
            records, self._checked(records, {DESCRIPTOR: descriptors, **(beside or {})})
        )
        with engine.writing(self.path):
            fragments = engine.write_fragments(self._table, rows) if records else []
        return Written(engine.described(fragments), tuple(rows["frame"].to_pylist()))

    def adopt(self, written: Sequence[Written]) -> None:
        """Adds rows that `write_apart` wrote, in one commit.

        Raises:
            ValueError: a frame is there already, or was written twice.
            OSError: the disk refused; the database is as it was.
        """
        self._change(written, "append")

    def _change(self, written: Sequence[Written], verb: str) -> None:
        """Puts rows in the place of those with their ids, as far as the verb allows."""
        self._see_writable()
        ids = pa.table({"frame": pa.array([f for w in written for f in w.frames], pa.string())})
        if len(pc.unique(ids["frame"])) < len(ids):
            raise ValueError(f"frames for {self.path} were written twice")

        def plan(table: LanceDataset) -> Any:
            there = _there(table, ids)
            if verb == "append" and there:
                raise ValueError(f"frame {there[0]!r} is in {self.path} already")
            if verb == "remove" and not there:
                return None
            fragments = [text for part in written for text in part.fragments]
            return engine.substitution(table, ids if there else None, fragments)

        if len(ids):
            self._commit(plan, f"{verb} {len(ids)} frames")

    def _commit(self, plan: Callable[[LanceDataset], Any], message: str) -> None:
        with self._writing:
            self._settle(engine.commit(self.path, plan, message))

    def _see_writable(self) -> None:
        if self._pinned:
            raise ValueError(f"{self.path} was opened as of version {self.version}, to read only")

    def _checked(
        self, records: Sequence[FrameRecord], descriptors: Mapping[str, Vectors]
    ) -> Arrays:
        """The descriptors as arrays by their columns, if they fit."""
        if descriptors.keys() != self._widths.keys():
            names, got = ", ".join(self._widths), ", ".join(descriptors)
            raise ValueError(f"{self.path} holds {names} of every frame, got {got}")
        arrays = {
            name: fitting(name, descriptors[name], (len(records), width))
            for name, width in self._widths.items()
        }
        if not all(record.name for record in records):
            raise ValueError(f"a frame for {self.path} has no name")
        often = Counter(record.frame for record in records).most_common(1)
        if often and often[0][1] > 1:
            raise ValueError(f"frame {often[0][0]!r} is given {often[0][1]} times")
        unknown = {record.origin for record in records} - {"", *self._meta.origins}
        if unknown:
            raise ValueError(f"origin {min(unknown)!r} is not in {self.path}: add_origin first")
        return arrays

    def known(self) -> KnownFrames:
        """The records of all frames, without their descriptors."""
        return KnownFrames(self._columns(OF_A_RECORD))

    def folders(self, damaged: bool = False) -> set[tuple[str, str]]:
        """See `folders_of`.

        Args:
            damaged: whether to pass over damaged frames.
        """
        names = ["signature", "sequence"]
        if not damaged:
            return folders_of(self._columns(names))
        rows = (batch.select(names) for batch in read_rows(self._table, []))
        return folders_of(
            pa.Table.from_batches(rows, pa.schema(map(self._table.schema.field, names)))
        )

    def placed(self) -> tuple[FrameSet, npt.NDArray[np.int64]]:
        """All frames as from `load`, but without descriptors and not verified, and ``(R,)`` the
        place of each among the rows as they are stored."""
        table = self._columns(OF_A_SET)
        order = order_of(table)
        return frame_set(
            table.take(order), {DESCRIPTOR: np.empty((len(order), 0), np.float32)}
        ), order

    def load(self, damage: list[Damage] | None = None) -> FrameSet:
        """All frames in memory, every byte of them verified.

        Args:
            damage: where given, what is damaged is left out and told here.

        Raises:
            ValueError: a row or a file is missing or damaged; the message names it.
        """
        arrays = {n: np.empty((len(self), width), np.float32) for n, width in self._widths.items()}
        tables, done = [schema({}).empty_table().select(OF_A_SET)], 0
        for batch in read_rows(self._table, damage):
            for name, values in arrays.items():
                values[done : done + len(batch)] = matrix(batch[name])
            done += len(batch)
            few = batch.select(OF_A_SET).take(pa.array(np.arange(len(batch))))
            tables.append(pa.table(few))  # a copy: as long as a part lives, so does the batch
        table = pa.concat_tables(tables)
        order = order_of(table)
        twice = table.num_rows - len(pc.unique(table["frame"]))
        if twice:
            raise ValueError(f"{self.path} is damaged: it holds {twice} frames twice")
        arrays = {name: in_order(values[:done], order) for name, values in arrays.items()}
        return frame_set(table.take(order), arrays)

    def _columns(self, names: list[str]) -> pa.Table:
        try:
            return self._table.to_table(columns=names, scan_in_order=True)
        except (OSError, ValueError, RuntimeError) as error:
            raise ValueError(f"{self.path} is damaged: {engine.one_line(error)}") from error

    def verify(self, progress: Callable[[int], object] | None = None) -> list[Damage]:
        """Everything that is not as it was written, found by reading all of it.

        Args:
            progress: called with the number of frames done since the last call.
        """
        damage: list[Damage] = []
        for batch in read_rows(self._table, damage):
            if progress:
                progress(len(batch))
        return damage

    def drop_damaged(self) -> list[Damage]:
        """Gives up what is damaged, in one commit; encoding the same files again brings it back.

        Returns:
            What was damaged.

        Raises:
            ValueError: the database was opened at a version.
            OSError: the disk refused; the database is as it was.
        """
        self._see_writable()
        damage: list[Damage] = []

        def plan(table: LanceDataset) -> Any:
            damage.clear()
            gone = [fragment for fragment in table.get_fragments() if is_damaged(fragment, damage)]
            if not gone:
                return None
            whole = (batch for fragment in gone for batch in read_intact(fragment, []))
            rows = pa.RecordBatchReader.from_batches(table.schema, whole)
            return engine.lance().LanceOperation.Update(
                removed_fragment_ids=[fragment.fragment_id for fragment in gone],
                new_fragments=engine.write_fragments(table, rows),
            )

        self._commit(plan, "drop what is damaged")
        return damage

    def table(self) -> LanceDataset:
        """The version that is read, as Lance's own; for what is not here."""
        return self._table

    def write_index(self, column: str, kind: str, lists: int, **options: Any) -> None:
        """Builds an index of cosines over a column; see `index.build_index`.

        Raises:
            ValueError: the database was opened at a version.
            OSError: the disk refused.
        """
        self._see_writable()
        with self._writing:
            self._settle(engine.create_index(self.path, column, kind, lists, **options))

    def history(self) -> list[Version]:
        """The versions that are kept, the oldest first."""
        told = []
        for entry in self._table.versions():
            number: Any = entry["version"]
            time: Any = entry["timestamp"]
            facts: Any = entry["metadata"]
            change = engine.message_of(self._table, number)
            told.append(Version(number, time, int(facts["total_rows"]), change))
        return told

    def compact(self, keep_days: float = 14) -> None:
        """Joins small files, and forgets old versions with the files that only these need.

        Args:
            keep_days: versions younger than this stay, for those who read them.

        Raises:
            ValueError: the database was opened at a version.
            OSError: the disk refused.
        """
        self._see_writable()
        with self._writing:
            self._settle(engine.compact(self.path, timedelta(days=keep_days)))

    def info(self) -> dict[str, Any]:
        """What is in the database, in numbers and words, ready for JSON; rows are not verified."""
        table = self._columns(["sequence", "x", "empty", "origin"])
        origins = {
            str(self._meta.origins.get(key, Origin())): count
            for key, count in Counter(table["origin"].to_pylist()).items()
        }
        config = self._meta.config
        return {
            "frames": len(table),
            "sequences": dict(Counter(table["sequence"].to_pylist())),
            "empty": int(np.count_nonzero(table["empty"].to_numpy())),
            "with_pose": int(np.count_nonzero(~np.isnan(table["x"].to_numpy()))),
            "label_spaces": origins,
            "width": self.width,
            "preset": config.preset if config else None,
            "fingerprint": self.fingerprint,
            "beside": {one.name: one.fingerprint for one in self.beside},
            "config": {**config.to_dict(), "labels_as": config.labels_name} if config else None,
            "version": self.version,
        }


def _is_used(folder: Path) -> bool:
    """Whether a folder holds more than a `Database.create` that was killed leaves behind."""
    left = {"_transactions", "_versions", "data"}
    return folder.is_dir() and any(entry.name not in left for entry in folder.iterdir())


def _there(table: LanceDataset, rows: pa.Table) -> list[str]:
    """Ids of rows that a table holds already, in the order of the rows."""
    there = pc.is_in(rows["frame"], table.to_table(columns=["frame"])["frame"])
    ids: list[str] = rows["frame"].filter(there).to_pylist()
    return ids
