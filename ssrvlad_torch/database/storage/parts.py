"""One part of a database: a Parquet file with a row a frame, written once and never changed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from torch import Tensor

from ...files import replacing

ROWS_OF_A_GROUP = 1024
_REPETITIVE = ["sequence", "labels_as"]
_ENCODING = {
    "descriptor.list.element": "BYTE_STREAM_SPLIT",
    **dict.fromkeys(("x", "y", "heading"), "BYTE_STREAM_SPLIT"),
}


class FrameRecord(NamedTuple):
    """What is stored of a frame beside its descriptor.

    Attributes:
        sequence, name: a frame's id is ``<sequence>/<name>``.
        labels_as: label space that the frame's ids were read in.
        height, width: size of the label map in pixels.
        digest: BLAKE2b-128 of the label map's bytes, in hex.
        x, y: position in metres, NaN where unknown.
        heading: radians, counter-clockwise from +x, NaN where unknown.
        stamp: a number that changes whenever the frame's file does, 0 where unknown.
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
    stamp: int = 0

    @property
    def frame(self) -> str:
        """The frame's id."""
        return f"{self.sequence}/{self.name}"


class Part(NamedTuple):
    """What the manifest says of a part.

    Attributes:
        file: its name in the database's folder.
        rows: number of frames.
        bytes: size of the file.
        sha256: of the whole file, in hex.
    """

    file: str
    rows: int
    bytes: int
    sha256: str


class Damage(NamedTuple):
    """Something that is not as it was written.

    Attributes:
        file: name in the database's folder.
        row_group: of a part, from 0; ``None`` where it is the file as a whole.
        reason: what is wrong, one line.
    """

    file: str
    row_group: int | None
    reason: str

    @property
    def place(self) -> str:
        """Where in the file, to stand after its name."""
        return "" if self.row_group is None else f", row group {self.row_group}"


def schema(length: int, columns: Sequence[str] | None = None) -> pa.Schema:
    """The columns of a part: those of `FrameRecord`, and ``length`` float32 of a descriptor."""
    text = pa.dictionary(pa.int32(), pa.string())
    whole = pa.schema(
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
            ("stamp", pa.int64()),
            ("descriptor", pa.list_(pa.float32(), length)),
        ]
    )
    return whole if columns is None else pa.schema([whole.field(name) for name in columns])


def to_table(records: Sequence[FrameRecord], descriptors: Tensor) -> pa.Table:
    """N records and their ``(N, D)`` descriptors as the rows of a part."""
    columns = {name: [getattr(r, name) for r in records] for name in FrameRecord._fields}
    wanted = schema(descriptors.shape[1])
    flat = pa.array(descriptors.detach().cpu().float().contiguous().numpy().ravel())
    arrays = [pa.array(columns[field.name], field.type) for field in list(wanted)[:-1]]
    arrays.append(pa.FixedSizeListArray.from_arrays(flat, descriptors.shape[1]))
    return pa.Table.from_arrays(arrays, schema=wanted)


def write_part(folder: Path, file: str, table: pa.Table) -> Part:
    """Writes rows as a part, whole and on the disk.

    Raises:
        OSError: the disk refused; there is no such part, or what was there before.
    """
    buffer = pa.BufferOutputStream()
    pq.write_table(
        table,
        buffer,
        row_group_size=ROWS_OF_A_GROUP,
        compression="zstd",
        use_dictionary=_REPETITIVE,
        column_encoding=_ENCODING,
        write_page_checksum=True,
        write_statistics=False,
    )
    content = memoryview(buffer.getvalue())
    with replacing(folder / file) as temporary, temporary.open("wb") as stream:
        stream.write(content)
    return Part(file, table.num_rows, len(content), hashlib.sha256(content).hexdigest())


def read_part(
    folder: Path, part: Part, length: int, columns: Sequence[str] | None = None
) -> pa.Table:
    """The rows of a part. All columns: the whole file is checked; some: the pages that are read.

    Raises:
        ValueError: the part is missing, damaged, or not the one that the manifest means.
    """
    path = folder / part.file
    try:
        source = pa.BufferReader(_content(path, part)) if columns is None else path
        with _opened(source) as file:
            table = file.read(columns, use_threads=False)
        table.validate(full=True)
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{path} is missing or damaged: {one_line(error)}") from error
    if not table.schema.equals(schema(length, columns)):
        raise ValueError(f"{path} is damaged: its columns are not those of a database")
    if table.num_rows != part.rows:
        raise ValueError(f"{path} has {table.num_rows} rows; the manifest wants {part.rows}")
    return table


def read_intact(
    folder: Path, part: Part, length: int, columns: Sequence[str] | None = None
) -> tuple[pa.Table, list[Damage]]:
    """The rows of a part whose row groups are whole, and what is damaged."""
    nothing, damage = schema(length).empty_table(), list[Damage]()
    try:
        whole = read_part(folder, part, length)
    except ValueError as error:
        groups, damage = _row_groups(folder, part, length)
        whole = pa.concat_tables([nothing, *groups])
        reason = str(error).removeprefix(f"{folder / part.file} ")
        damage = damage or [Damage(part.file, None, f"{reason}; every row group is whole")]
    return whole if columns is None else whole.select(list(columns)), damage


def matrix(column: pa.ChunkedArray, length: int) -> npt.NDArray[np.float32]:
    """``(N, D)`` float32 of a column of descriptors."""
    chunks = [chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks]
    flat = chunks[0] if len(chunks) == 1 else np.concatenate([np.empty(0, np.float32), *chunks])
    return flat.reshape(-1, length)


def one_line(error: Exception) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split())


def _opened(source: Path | pa.BufferReader) -> pq.ParquetFile:
    """To be read without pyarrow's threads: they sometimes abort a process that ends while they
    wind up (https://github.com/apache/arrow/issues/34314)."""
    return pq.ParquetFile(source, page_checksum_verification=True, pre_buffer=False)


def _content(path: Path, part: Part) -> bytes:
    content = path.read_bytes()
    if len(content) != part.bytes:
        raise OSError(f"it has {len(content)} bytes, the manifest wants {part.bytes}")
    if hashlib.sha256(content).hexdigest() != part.sha256:
        raise OSError("its checksum is not that of the manifest")
    return content


def _row_groups(folder: Path, part: Part, length: int) -> tuple[list[pa.Table], list[Damage]]:
    """What can be read of a damaged part."""
    try:
        file = _opened(folder / part.file)
    except (OSError, pa.ArrowException) as error:
        return [], [Damage(part.file, None, one_line(error))]
    groups, damage = [], []
    with file:
        for number, group in _read_groups(file):
            if isinstance(group, str):
                damage.append(Damage(part.file, number, group))
            elif group.schema.equals(schema(length)):
                groups.append(group)
            else:
                damage.append(Damage(part.file, number, "not the columns of a database"))
    return groups, damage


def _read_groups(file: pq.ParquetFile) -> Iterator[tuple[int, Any]]:
    for number in range(file.metadata.num_row_groups):
        try:
            group = file.read_row_group(number, use_threads=False)
            group.validate(full=True)
            yield number, group
        except (OSError, pa.ArrowException) as error:
            yield number, one_line(error)
