"""The table of a database: its metadata (settings, columns, origins of label maps), and frames as
rows: written with a checksum, and read with verified ones."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from ..channels import Column
from ..config import SSRVLADConfig
from ..files import InputError, input_errors, natural_key
from ..taxonomy import LabelSpace, label_space, label_space_names
from .engine import lance, lance_errors, write_fragments
from .frames import FrameRecord, FrameSet, checked_pose, is_text

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import LanceFragment
    from torch import Tensor

    from ..recognition.matching import Vectors

FORMAT = "ssrvlad-database-6"

DESCRIPTOR = "descriptor"
"""The column of custom descriptors."""

POSE = ["x", "y", "heading"]
RECORD_COLUMNS = ["frame", "sequence", *POSE, "stamp", "signature", "digest", "height", "width"]
RECORD_COLUMNS += ["origin", "arrival"]
FRAME_SET_COLUMNS = ["frame", "sequence", *POSE, "stamp", "empty"]
"""The columns that a `FrameSet` holds beside descriptors."""

_META, _DIGEST, _ORIGIN = "ssrvlad", "ssrvlad-digest", "origin:"
_MULTIPLIER = 0x9E3779B97F4A7C15
_BATCH = 4096


class Origin(NamedTuple):
    """The label space of label maps, ``None`` if unknown, and the network that made them, if they
    were not read from files: its identity, and the name that opens it again, if known, which is not
    part of the key."""

    label_space: LabelSpace | None = None
    segmenter: str = ""
    network: str = ""

    @property
    def key(self) -> str:
        """16 hex digits, a hash of `LabelSpace.digest` and the segmenter."""
        return _digest(json.dumps([self.label_space and self.label_space.digest, self.segmenter]))

    def __str__(self) -> str:
        name = self.label_space.name if self.label_space else "unknown"
        return f"{name} by {self.network or self.segmenter}" if self.segmenter else name

    def to_entry(self) -> dict[str, str]:
        """The origin as an entry of a table's metadata."""
        space = self.label_space and self.label_space.to_dict()
        return {_ORIGIN + self.key: json.dumps({**self._asdict(), "label_space": space})}

    @classmethod
    def of_entry(cls, key: str, text: str) -> Origin:
        """The origin that `to_entry` wrote."""
        stored = json.loads(text)
        space = stored.pop("label_space")
        origin = cls(space and LabelSpace.from_dict(space), **stored)
        if not isinstance(origin.network, str) or origin.key != key:
            raise ValueError(f"origin {key} does not match its content")
        return origin


class Metadata(NamedTuple):
    """Settings of the first column, if any, columns of descriptors, and origins by their keys."""

    config: SSRVLADConfig | None
    columns: tuple[Column, ...]
    origins: dict[str, Origin]


def metadata_of(stored: pa.Schema, path: str) -> Metadata:
    """The metadata in the schema of the table at ``path``. A table that is no database of this
    format, is damaged, or was made by another version of the method is a ValueError."""
    with input_errors(path, "damaged, or a database of another version"):
        entries = {key.decode(): text.decode() for key, text in (stored.metadata or {}).items()}
        text = entries.get(_META, "{}")
        content = json.loads(text)
        form = content.get("format", "")
        if form != FORMAT and form.startswith("ssrvlad-"):
            raise InputError(f"{path} has another format, {form}: encode it again")
        if form != FORMAT:
            raise InputError(f"{path} is a table of Lance, but not a database of {FORMAT}")
        if entries.get(_DIGEST) != _digest(text):  # Lance does not notice a flipped byte
            raise InputError(f"{path} is damaged: the checksum of its settings does not match")
        columns = tuple(Column(**{**of, "shape": tuple(of["shape"])}) for of in content["columns"])
        if not stored.equals(schema(columns)):
            raise InputError(f"{path} has other columns than a database of this version")
        config = content["config"] and SSRVLADConfig.from_dict(content["config"])
        if config and config.fingerprint != columns[0].fingerprint:
            raise InputError(
                f"{path} has fingerprint {columns[0].fingerprint}, made by another version of "
                f"the method; the same settings have {config.fingerprint} here: encode it again"
            )
        space = config and config.labels_as
        if isinstance(space, str) and space not in label_space_names():
            raise ValueError(f"label space {space!r}; expected a built-in one")
        origins = {
            key: Origin.of_entry(key, entries[name])
            for name in entries
            if (key := name.removeprefix(_ORIGIN)) != name
        }
    return Metadata(config, columns, origins)


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def schema(columns: Sequence[Column]) -> pa.Schema:
    """The columns of a database, with those of descriptors."""
    kinds = dict.fromkeys(RECORD_COLUMNS, pa.string())
    kinds |= dict.fromkeys([*POSE, "stamp"], pa.float64())
    kinds |= {"height": pa.int32(), "width": pa.int32(), "arrival": pa.int64(), "empty": pa.bool_()}
    for column in columns:
        numbers = pa.from_numpy_dtype(column.dtype)
        kinds[column.name] = pa.list_(numbers, math.prod(column.shape))
    kinds["checksum"] = pa.uint64()
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in kinds.items()])


def new_schema(config: SSRVLADConfig | None, columns: Sequence[Column]) -> pa.Schema:
    """The schema of a new table with its metadata, which has no origins; a custom label space is
    stored in it. A name of a column that another one has is a ValueError."""
    names = [column.name for column in columns]
    if len({*names, *schema([]).names}) < len(names) + len(schema([])):
        got = ", ".join(names)
        raise ValueError(f"expected unique names of channels that no column has, got {got}")
    if config and config.labels_as not in label_space_names():
        config = dataclasses.replace(config, labels_as=label_space(config.labels_as))
    content = {
        "format": FORMAT,
        "config": config and config.to_dict(),
        "columns": [column._asdict() for column in columns],
    }
    text = json.dumps(content)
    return schema(columns).with_metadata({_META: text, _DIGEST: _digest(text)})


def to_table(
    records: Sequence[FrameRecord], descriptors: Mapping[str, Vectors], columns: Sequence[Column]
) -> pa.Table:
    """N records and their descriptors ``(N, *shape)`` as rows; a frame is empty if its first one is
    zero. Descriptors of another shape or dtype, and rows of numbers that are not finite or whose
    length does not fit into float32, are a ValueError."""
    cells: dict[str, Any] = {
        name: [getattr(record, name) for record in records] for name in RECORD_COLUMNS
    }
    for column in columns:
        values = _checked(column, descriptors[column.name], len(records))
        if column is columns[0]:
            cells["empty"] = ~values.any(axis=1)
        flat = pa.array(np.ascontiguousarray(values).ravel())
        cells[column.name] = pa.FixedSizeListArray.from_arrays(flat, math.prod(column.shape))
    cells["checksum"] = np.zeros(len(records), np.uint64)
    table = pa.table(cells, schema=schema(columns))
    index = table.schema.get_field_index("checksum")
    return table.set_column(index, table.schema.field(index), pa.array(checksums(table)))


def _checked(column: Column, descriptors: Vectors, frames: int) -> npt.NDArray[Any]:
    """The descriptors of some frames as an array; errors as for `to_table`."""
    name, dtype, shape = column.name, column.dtype, (frames, *column.shape)
    detach = getattr(descriptors, "detach", None)
    values = np.asarray(detach().cpu() if detach else descriptors)
    if values.dtype.kind not in "biuf" or (dtype == "uint8") != (values.dtype == np.uint8):
        raise ValueError(f"{name}: expected {dtype}, got {values.dtype}")
    if values.shape != shape:
        raise ValueError(f"{name}: expected {shape} for {frames} frames, got {values.shape}")
    values = values.astype(dtype, copy=False)
    if dtype == "float32":
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: values that are not finite")
        with np.errstate(over="ignore"):
            squares = np.einsum("ij,ij->i", values, values)
        if not np.isfinite(squares).all() or values[squares == 0].any():
            raise ValueError(f"{name}: values too large or too small for a length in float32")
    return values


def check_records(records: Sequence[FrameRecord], origins: Collection[str]) -> None:
    """Raises a ValueError for what is no id, no UTF-8 or there twice, for half a position or an
    infinite one, and for an origin that is not among these."""
    frames, origins = Counter(record.frame for record in records), {"", *origins}
    for record in records:
        if not is_text(record.frame):
            raise ValueError(f"expected UTF-8 in the id of a frame, got {record.frame!a}")
        of_id = FrameRecord.of_id(record.frame)
        if (of_id.sequence, of_id.name) != (record.sequence, record.name):
            raise ValueError(f"expected the name of a frame without '/', got {record.name!r}")
        if frames[record.frame] > 1:
            raise ValueError(f"frame {record.frame!r} is there {frames[record.frame]} times")
        checked_pose((record.x, record.y, record.heading), record.frame)
        if record.origin not in origins:
            raise ValueError(f"origin {record.origin!r} is not in the database: add_origin first")


class StoredRecords(Mapping[str, FrameRecord]):
    """The records of a database by frame id, in the order in which they are stored in ``table``
    with the columns `RECORD_COLUMNS`. A record is built when it is looked up, so that millions of
    them take little memory."""

    def __init__(self, table: pa.Table) -> None:
        self.table = table.combine_chunks()
        self._columns = self.table.columns
        self._rows = {frame: row for row, frame in enumerate(table["frame"].to_pylist())}

    def __getitem__(self, frame: str) -> FrameRecord:
        row = self._rows[frame]
        _, sequence, *fields = (column[row].as_py() for column in self._columns)
        return FrameRecord(sequence, frame[len(sequence) + 1 :] if sequence else frame, *fields)

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


def folder_of(signature: str) -> str:
    """The folder in a frame's signature, empty if unknown."""
    return signature.rpartition("|")[0]


def folders_of(table: pa.Table) -> set[tuple[str, str]]:
    """Pairs of the folder that rows were encoded from, empty if unknown, and their sequence."""
    folders = map(folder_of, table["signature"].to_pylist())
    return set(zip(folders, table["sequence"].to_pylist(), strict=True))


def intact(rows: pa.Table | pa.RecordBatch) -> npt.NDArray[np.bool_]:
    """``(N,)`` bool, the rows whose checksum is correct. Lance reads most flipped bytes without an
    error (`test_a_changed_byte_of_a_data_file_is_reported_or_has_no_effect`)."""
    fits: npt.NDArray[np.bool_] = checksums(rows) == rows["checksum"].to_numpy()
    return fits


def checksums(rows: pa.Table | pa.RecordBatch) -> npt.NDArray[np.uint64]:
    """``(N,)`` uint64, the checksum of each row, over all columns but ``checksum``. Any change of a
    single word of a row changes its checksum: words are multiplied by odd numbers modulo 2^64,
    which is one to one."""
    if isinstance(rows, pa.Table):
        sums = [checksums(batch) for batch in rows.to_batches()]
        return np.concatenate([np.zeros(0, np.uint64), *sums])
    total = np.zeros(rows.num_rows, np.uint64)
    for name, column in zip(rows.schema.names, rows.columns, strict=True):
        if name != "checksum":
            total = (total ^ _words(column)) * np.uint64(_MULTIPLIER)
    return total


def _words(column: pa.Array) -> npt.NDArray[np.uint64]:
    """A word for each value of a column."""
    if pa.types.is_fixed_size_list(column.type):
        return _hash_rows(matrix(column))
    if not pa.types.is_string(column.type):
        values = column.to_numpy(zero_copy_only=False)
        words: npt.NDArray[np.uint64] = (
            values.view(np.uint64) if values.dtype == np.float64 else values.astype(np.uint64)
        )
        return words
    # the hash of the bytes of each text, padded to a row of a matrix, plus its length
    _, offsets, content = column.buffers()
    ends = np.frombuffer(offsets, np.int32)[column.offset :][: len(column) + 1]
    lengths = np.diff(ends)
    padded = np.zeros((len(column), lengths.max(initial=0)), np.uint8)
    text = np.frombuffer(content or b"", np.uint8)[ends[0] : ends[-1]]
    padded[np.arange(padded.shape[1], dtype=np.int32) < lengths[:, None]] = text
    return _hash_rows(padded) + lengths.astype(np.uint64)


def matrix(column: pa.ChunkedArray | pa.Array) -> npt.NDArray[Any]:
    """A column of ``(N, D)`` float32 numbers or uint8 signs; of one chunk, not copied."""
    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    values: npt.NDArray[Any] = column.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(len(column), column.type.list_size)


def _hash_rows(values: npt.NDArray[Any]) -> npt.NDArray[np.uint64]:
    """For each row of a matrix, the sum of its words of 8 bytes, each times its own odd number."""
    if padding := -values.shape[1] % (8 // values.itemsize):
        values = np.pad(values, ((0, 0), (0, padding)))
    words = np.ascontiguousarray(values).view(np.uint64)
    numbers = np.cumprod(np.full(words.shape[1], _MULTIPLIER, np.uint64), dtype=np.uint64)
    hashes: npt.NDArray[np.uint64] = np.einsum("ij,j->i", words, numbers)
    return hashes


class Damage(NamedTuple):
    """A file below the database's folder, the number of frames that are lost, and a line why."""

    file: str
    rows: int
    reason: str


def read_rows(fragments: Iterable[LanceFragment], damage: list[Damage]) -> Iterator[pa.RecordBatch]:
    """The intact rows of data files in the order in which they are stored, of each up to where it
    cannot be read; the damage of a file is appended to ``damage`` at its end."""
    for fragment in fragments:
        intact_rows, reason = 0, ""
        file = f"data/{fragment.metadata.files[0].path}"
        try:
            with lance_errors(ValueError, file):
                for batch in fragment.to_batches(batch_size=_BATCH):
                    fits = intact(batch)
                    if not fits.all():
                        frame = batch["frame"][int(np.argmin(fits))].as_py()
                        reason = reason or f"the checksum of frame {frame!r} differs"
                    intact_rows += int(fits.sum())
                    yield batch if fits.all() else batch.filter(pa.array(fits))
        except ValueError as error:
            reason = reason or str(error).removeprefix(f"{file}: ")
        if reason:
            damage.append(Damage(file, fragment.metadata.num_rows - intact_rows, reason))


def without_damage(table: LanceDataset, damage: list[Damage]) -> Any:
    """The operation that replaces damaged data files by their intact rows, ``None`` without damage;
    ``damage`` is set to what is damaged."""
    damage.clear()
    damaged = []
    for fragment in table.get_fragments():
        before = len(damage)
        deque(read_rows([fragment], damage), maxlen=0)
        damaged += [fragment] if len(damage) > before else []
    if not damaged:
        return None
    rows = pa.RecordBatchReader.from_batches(table.schema, read_rows(damaged, []))
    return lance().LanceOperation.Update(
        removed_fragment_ids=[fragment.fragment_id for fragment in damaged],
        new_fragments=write_fragments(table, rows),
    )


def in_natural_order(table: pa.Table) -> tuple[FrameSet, npt.NDArray[np.int64]]:
    """The frames of a table with `FRAME_SET_COLUMNS`, without descriptors, by sequence and name in
    natural order, and ``(R,)`` the row of each."""
    coded = pc.dictionary_encode(table["sequence"]).combine_chunks()
    sequences = [*map(natural_key, coded.dictionary.to_pylist())]
    by_sequence = sorted(range(len(sequences)), key=sequences.__getitem__)
    ranks = np.argsort(np.array(by_sequence, np.int64))[coded.indices.to_numpy()]
    names = pc.replace_substring_regex(table["frame"], "(?s)^.*/", "")
    if len(pc.unique(pc.replace_substring_regex(names, "[0-9]", "0"))) == 1:  # differ in digits
        by_name = np.asarray(pc.sort_indices(names)).astype(np.int64)  # by character, faster
    else:
        keys = [*map(natural_key, names.to_pylist())]
        by_name = np.array(sorted(range(len(keys)), key=keys.__getitem__), np.int64)
    order = by_name[np.argsort(ranks[by_name], kind="stable")]
    ordered = table.take(order)
    frames = FrameSet(
        frames=tuple(ordered["frame"].to_pylist()),
        sequences=tuple(ordered["sequence"].to_pylist()),
        channels={},
        poses=np.stack([ordered[axis].to_numpy() for axis in POSE], axis=1),
        stamps=ordered["stamp"].to_numpy(),
        empty=ordered["empty"].to_numpy(),
    )
    return frames, order


def load_descriptors(
    table: LanceDataset, columns: Sequence[Column], order: npt.NDArray[np.int64]
) -> dict[str, Tensor]:
    """``(R, *shape)`` by column: the rows of a table in an order. Damage is a ValueError."""
    import torch

    rows, done, damage = np.argsort(order), 0, list[Damage]()
    descriptors: dict[str, Tensor] = {}
    for column in columns:
        dtype = getattr(torch, column.dtype)
        descriptors[column.name] = torch.zeros(len(rows), *column.shape, dtype=dtype)
    for batch in read_rows(table.get_fragments(), damage):
        for column in columns:
            values = matrix(batch[column.name]).reshape(-1, *column.shape)
            descriptors[column.name].numpy()[rows[done : done + len(batch)]] = values
        done += len(batch)
    if damage:
        raise ValueError(f"{table.uri} is damaged: {damage[0].file}: {damage[0].reason}")
    return descriptors
