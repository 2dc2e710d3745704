"""A database of descriptors on disk: Parquet parts and a manifest.

A database is a folder with ``manifest.json`` and ``part-000000.parquet``, ``part-000001.parquet``
and so on. A part holds one row a frame and is never changed once written. The manifest names the
parts that count, so a part that a crash left behind is invisible. Both are written under a
temporary name, flushed to the disk and renamed.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import re
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from .config import SSRVLADConfig
from .files import replacing
from .matching import temporal_sum

FORMAT = "ssrvlad-database"
FORMAT_VERSION = 1
_MANIFEST = "manifest.json"
_LOCK = "lock"
_REPETITIVE = ["sequence", "labels_as"]
_PART_NAME = re.compile(r"part-\d{6,}\.parquet")


class FrameRecord(NamedTuple):
    """What is stored of a frame beside its descriptor.

    Attributes:
        sequence, name: a frame's id is ``<sequence>/<name>``.
        labels_as: label space that the frame's ids were read in.
        height, width: size of the label map in pixels.
        digest: BLAKE2b-128 of the label map's bytes, in hex.
        x, y: position in metres, NaN where unknown.
        heading: radians, counter-clockwise from +x, NaN where unknown.
    """

    sequence: str
    name: str
    labels_as: str
    height: int
    width: int
    digest: str
    x: float = float("nan")
    y: float = float("nan")
    heading: float = float("nan")

    @property
    def frame(self) -> str:
        """The frame's id."""
        return f"{self.sequence}/{self.name}"


@dataclass(frozen=True)
class FrameSet:
    """Frames in memory, those of a sequence one after another in order.

    Attributes:
        frames: ids, ``<sequence>/<name>``.
        sequences: the sequence of each frame.
        descriptors: ``(R, D)`` float32, of references after Eq. 3 if it was asked for.
        poses: ``(R, 3)`` float64, x and y in metres and heading in radians, NaN where unknown.
        empty: ``(R,)`` bool, frames whose own descriptor is zero; they match nothing.
    """

    frames: tuple[str, ...]
    sequences: tuple[str, ...]
    descriptors: Tensor
    poses: npt.NDArray[np.float64]
    empty: npt.NDArray[np.bool_]


class Database:
    """Descriptors of one fingerprint on disk.

    Use `create`, `open` or `open_or_create`.

    Attributes:
        path: the folder.
        config: the settings of every descriptor in it; ``labels_as`` is that of the first frames.
    """

    def __init__(
        self, path: Path, config: SSRVLADConfig, parts: tuple[dict[str, Any], ...]
    ) -> None:
        self.path = path
        self.config = config
        self._parts = parts
        self._digests: dict[str, str] = {}
        self._parts_known = 0

    @staticmethod
    def exists(path: str | Path) -> bool:
        """Whether a folder is a database."""
        return (Path(path) / _MANIFEST).is_file()

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
        database = cls(path, config, ())
        with database._locked():
            if cls.exists(path):
                raise ValueError(f"{path} is a database already")
            database._write_manifest(())
        return database

    @classmethod
    def open(cls, path: str | Path) -> Database:
        """An existing database.

        Raises:
            ValueError: the folder is no database, its manifest is damaged or of another format, or
                its settings give other descriptors in this version of the method.
        """
        path = Path(path)
        manifest = _read_manifest(path)
        try:
            config = SSRVLADConfig.from_dict(manifest["config"])
        except ValueError as error:
            raise ValueError(f"{path} has settings of another version: {error}") from error
        if config.fingerprint != manifest["fingerprint"]:
            raise ValueError(
                f"{path} has fingerprint {manifest['fingerprint']}, made by another version of the "
                f"method; the same settings have {config.fingerprint} here: encode it anew"
            )
        return cls(path, config, tuple(manifest["parts"]))

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
    def fingerprint(self) -> str:
        """Fingerprint of every descriptor in the database."""
        return self.config.fingerprint

    def __len__(self) -> int:
        return sum(part["rows"] for part in self._parts)

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
        if descriptors.shape != (len(records), self.config.length):
            raise ValueError(
                f"wanted ({len(records)}, {self.config.length}) descriptors for "
                f"{len(records)} frames, got {tuple(descriptors.shape)}"
            )
        if not bool(torch.isfinite(descriptors).all()):
            raise ValueError("descriptors hold values that are not finite")
        if not records:
            return
        with self._locked():
            current = Database.open(self.path)
            current.require(self.config)
            self._parts = current._parts
            _refuse_repeated(records, self.digests(), self.path)
            name = f"part-{len(self._parts):06d}.parquet"
            table = _to_table(records, descriptors)
            with replacing(self.path / name) as temporary:
                pq.write_table(
                    table, temporary, write_page_checksum=True, use_dictionary=_REPETITIVE
                )
            parts = (*self._parts, {"file": name, "rows": len(records)})
            self._write_manifest(parts)
            self._parts = parts

    def digests(self) -> dict[str, str]:
        """Digest of the label map of every frame, by the frame's id."""
        for part in self._parts[self._parts_known :]:
            columns = self._read_part(part, ["sequence", "name", "digest"]).to_pydict()
            rows = zip(columns["sequence"], columns["name"], columns["digest"], strict=True)
            self._digests.update((f"{sequence}/{name}", digest) for sequence, name, digest in rows)
            self._parts_known += 1
        return self._digests

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """The rows as they are stored, page checksums verified.

        Raises:
            ValueError: a part is missing or damaged; the message names it.
        """
        tables = [self._read_part(part, columns) for part in self._parts]
        return pa.concat_tables([_schema(self.config.length, columns).empty_table(), *tables])

    def load(self, temporal: int = 0) -> FrameSet:
        """All frames in memory.

        Args:
            temporal: t of Eq. 3, frames summed on either side; 0 gives the raw descriptors.

        Raises:
            ValueError: a part is missing or damaged; the message names it.
        """
        table = self.table()
        columns = table.select(["sequence", "name"]).to_pydict()
        names = list(zip(columns["sequence"], columns["name"], strict=True))
        order = sorted(
            range(len(names)), key=lambda row: [natural_key(part) for part in names[row]]
        )
        table = table.take(pa.array(order, pa.int64()))
        sequences = tuple(names[row][0] for row in order)
        descriptors = _matrix(table["descriptor"], self.config.length)
        return FrameSet(
            frames=tuple("/".join(names[row]) for row in order),
            sequences=sequences,
            descriptors=temporal_sum(descriptors, sequences, temporal) if temporal else descriptors,
            poses=np.stack([table[axis].to_numpy() for axis in ("x", "y", "heading")], axis=1),
            empty=~descriptors.any(dim=1).numpy(),
        )

    def _read_part(self, part: dict[str, Any], columns: list[str] | None) -> pa.Table:
        path = self.path / part["file"]
        try:
            table = pq.read_table(path, columns=columns, page_checksum_verification=True)
            table.validate(full=True)
        except (OSError, pa.ArrowException) as error:
            raise ValueError(f"{path} is missing or damaged: {_one_line(error)}") from error
        if not table.schema.equals(_schema(self.config.length, columns)):
            raise ValueError(f"{path} is damaged: its columns are not those of a database")
        if table.num_rows != part["rows"]:
            raise ValueError(f"{path} has {table.num_rows} rows; the manifest wants {part['rows']}")
        return table

    def _write_manifest(self, parts: tuple[dict[str, Any], ...]) -> None:
        manifest = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "fingerprint": self.fingerprint,
            "config": self.config.to_dict(),
            "parts": list(parts),
        }
        manifest["checksum"] = _checksum(manifest)
        with replacing(self.path / _MANIFEST) as temporary:
            temporary.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with (self.path / _LOCK).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ValueError(f"{self.path} is being written by another process") from error
            yield


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts ``frame10`` after ``frame9``, as a person would, ``1`` after ``01``."""
    pieces = re.split(r"(\d+)", name)
    key = [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces if p]
    return [*key, (-1, 0, name)]


def _is_vacant(folder: Path) -> bool:
    """Whether a folder is empty but for what a `Database.create` that was killed leaves behind."""
    return all(
        entry.name == _LOCK or entry.name.startswith(f".{_MANIFEST}.") for entry in folder.iterdir()
    )


def _refuse_repeated(records: Sequence[FrameRecord], known: Container[str], path: Path) -> None:
    seen: set[str] = set()
    for record in records:
        if record.frame in known or record.frame in seen:
            raise ValueError(f"frame {record.frame!r} is in {path} already")
        seen.add(record.frame)


def _schema(length: int, columns: list[str] | None = None) -> pa.Schema:
    text = pa.dictionary(pa.int32(), pa.string())
    schema = pa.schema(
        [
            ("sequence", text),
            ("name", pa.string()),
            ("labels_as", text),
            ("height", pa.int32()),
            ("width", pa.int32()),
            ("digest", pa.string()),
            ("x", pa.float64()),
            ("y", pa.float64()),
            ("heading", pa.float64()),
            ("descriptor", pa.list_(pa.float32(), length)),
        ]
    )
    return schema if columns is None else pa.schema([schema.field(name) for name in columns])


def _to_table(records: Sequence[FrameRecord], descriptors: Tensor) -> pa.Table:
    schema = _schema(descriptors.shape[1])
    columns = {name: [getattr(r, name) for r in records] for name in FrameRecord._fields}
    flat = pa.array(descriptors.detach().cpu().float().contiguous().numpy().ravel())
    arrays = [pa.array(columns[field.name], field.type) for field in list(schema)[:-1]]
    arrays.append(pa.FixedSizeListArray.from_arrays(flat, descriptors.shape[1]))
    return pa.Table.from_arrays(arrays, schema=schema)


def _matrix(column: pa.ChunkedArray, length: int) -> Tensor:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return torch.from_numpy(np.array(flat, np.float32).reshape(-1, length))


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / _MANIFEST
    if not Database.exists(path):
        raise ValueError(f"{path} is not a database: it has no {_MANIFEST}")
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{file} cannot be read: {_one_line(error)}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{path} is not a database: {_MANIFEST} is of another format")
    if manifest.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"{path} has database format {manifest.get('format_version')}; "
            f"this version reads {FORMAT_VERSION}"
        )
    checksum = manifest.pop("checksum", None)
    if checksum != _checksum(manifest):
        raise ValueError(f"{file} is damaged: its checksum does not fit")
    for part in manifest["parts"]:
        if not _PART_NAME.fullmatch(part["file"]):
            raise ValueError(f"{file} names a part {part['file']!r}; wanted part-NNNNNN.parquet")
    return manifest


def _checksum(manifest: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
