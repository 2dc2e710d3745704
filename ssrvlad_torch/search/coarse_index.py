"""The coarse index of a database on disk: all its channels in few bytes, scanned for candidates.

It stands beside the rows, in files for each data file of the table: new data files get new ones,
and rows that were removed are left out when it is opened. A sample of the rows shows how the scores
of a query are spread over the map, and sums of the descriptors of each sequence give its mean.
"""

from __future__ import annotations

import json
import math
import re
import secrets
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from numpy.lib import format as npy
from torch import Tensor

from ..channels import Column, coarse
from ..channels.coarse import Coarse, Codes
from ..database.engine import lance_errors
from ..database.reading import Damage, read_intact
from ..database.rows import intact, matrix
from ..files import input_errors, is_uri, path_within, read_json, read_npz, replacing
from .sums import Sums, mean_of, refuse_many_files, sums, writing_sums

if TYPE_CHECKING:
    import pyarrow as pa
    from lance.fragment import LanceFragment

    from ..database.database import Database

FOLDER, _ABOUT, _LEARNT, _SAMPLED = "_coarse", "index.json", "learnt.npz", "sample.npz"
LEAST_ROWS = 20_000
"""Maps of fewer frames are loaded and searched in memory, see docs/scale.md."""

_FORMAT = 4
_LEARNT_FOLDER = "[0-9a-f]{8}"
_FILE = (
    r"(learnt|sample)\.npz|[0-9a-f-]{32,64}"
    r"\.(sums\.npz|checksums\.json|(sums|\d+)\.[^/\\]+\.npy)"
)
"""Names of what an index writes; nothing else is deleted."""
_SAMPLE, _SAMPLE_BYTES, _GROWTH = 4096, 1 << 27, 4
"""Rows and bytes of the sample, at most; a map that has grown so many times is learnt anew."""
_BLOCK, _OFFSET = 1 << 12, np.uint64((1 << 32) - 1)


class Report(NamedTuple):
    """The frames that `build` indexed now and in all, the bytes of the index, and the seconds."""

    new: int
    frames: int
    bytes: int
    seconds: float


def build(database: Database) -> Report:
    """Indexes the frames of a database that its coarse index lacks, or has in damaged files; all if
    there is none, if it is of other channels, or if the map has grown much since. A database that
    is damaged, in an object store, or without frames is a ValueError, an index that cannot be
    written an OSError."""
    if is_uri(database.path):
        raise ValueError(f"an index needs a folder on this machine, {database.path} is a URI")
    rows, began = len(database), time.perf_counter()
    if not rows:
        raise ValueError(f"{database.path} holds no frames yet")
    learnt = _learnt(database)
    if learnt is None or rows > _GROWTH * learnt.rows or learnt.columns != _columns(database):
        learnt = _learn(database)
        _remove_others(learnt.folder)
    fragments, new, columns = database.table().get_fragments(), 0, database.columns
    for fragment in fragments:
        part = _part(fragment, learnt.forms, columns, learnt.folder)
        if part is None or _damaged(learnt.folder / _stem(fragment)) != []:
            _write(fragment, learnt.forms, columns, learnt.folder)
            new += fragment.count_rows()
    stems = {_stem(fragment) for fragment in fragments} | {_LEARNT[:-4], _SAMPLED[:-4]}
    stems |= {path.stem for path in Path(database.path, "data").glob("*.lance")}
    files = _files(learnt.folder)
    for file in files:
        if file.name.split(".")[0] not in stems:
            file.unlink(missing_ok=True)
    size = sum(file.stat().st_size for file in files if file.exists())
    return Report(new, rows, size, time.perf_counter() - began)


def grow(database: Database) -> None:
    """Indexes the frames that the coarse index of a database lacks, if it has one."""
    if is_indexed(database) and len(database):
        build(database)


def is_indexed(database: Database) -> bool:
    """Whether a database has a coarse index, in whatever state."""
    return not is_uri(database.path) and (_folder(database) / _ABOUT).exists()


def damaged(database: Database) -> list[str]:
    """The files of the coarse index that are not as they were written, below the database's folder;
    none without an index. Opening an index does not read them."""
    if not is_indexed(database):
        return []
    learnt = _learnt(database)
    if learnt is None:
        return [f"{FOLDER}/{_ABOUT}"]
    stems = (learnt.folder / _stem(fragment) for fragment in database.table().get_fragments())
    files = [file for stem in stems for file in _damaged(stem) or ()]
    return [file.relative_to(database.path).as_posix() for file in files]


class CoarseIndex:
    """The coarse index of a database, opened. Rows are counted as they are stored.

    Attributes:
        sample: descriptors ``(N, *shape)`` of some rows by channel.
    """

    def __init__(self, database: Database) -> None:
        """Raises a ValueError in one line if there is no index, or one of other channels, or older
        than the rows, or damaged."""
        path = database.path
        if not is_indexed(database):
            raise ValueError(f"{path} has no index; ssrvlad db index builds one")
        learnt = _learnt(database)
        if learnt is None:
            raise ValueError(
                f"the index of {path} is damaged, or of another version; ssrvlad db index builds "
                "it anew"
            )
        if learnt.columns != _columns(database):
            raise ValueError(
                f"the index of {path} is of other channels; ssrvlad db index builds it anew"
            )
        self._forms, self.sample = learnt.forms, learnt.sample
        self._database, self._columns = database, {c.name: c for c in database.columns}
        table, lacking = database.table(), 0
        addresses = table.to_table(columns=[], with_row_address=True, scan_in_order=True)
        address = addresses["_rowaddr"].to_numpy()
        self._parts, self._rows = list[_Part](), len(address)
        for fragment in table.get_fragments():
            of = address[address >> np.uint64(32) == np.uint64(fragment.fragment_id)]
            live = (of & _OFFSET).astype(np.int64)
            part = _part(fragment, learnt.forms, database.columns, learnt.folder)
            if part is None:
                lacking += len(live)
                continue
            whole = len(live) == fragment.physical_rows
            self._parts.append(part if whole else part._replace(live=live))
        if lacking:
            raise ValueError(
                f"the index of {path} lacks {lacking} of {self._rows} frames; ssrvlad db index "
                "adds them"
            )

    def scan(self, name: str, queries: Sequence[Tensor], sweep: bool = True) -> Tensor:
        """``(Q, R)`` float32 coarse scores of descriptors by one channel to all rows."""
        first, form = 0, self._forms[name]
        scores = torch.empty(len(queries), self._rows, dtype=torch.float32)
        for part in self._parts:
            found = form.scan(queries, part.codes[name][0], part.rows, sweep)
            found = found if part.live is None else found[:, torch.from_numpy(part.live)]
            scores[:, first : first + found.shape[1]] = found
            first += found.shape[1]
        return scores

    def rescan(self, name: str, query: Tensor, rows: Tensor, sweep: bool) -> Tensor | None:
        """``(N,)`` float32 scores of a descriptor to some rows by all layers of the codes of one
        channel; ``None`` if there is one layer."""
        form, first, found = self._forms[name], 0, torch.empty(len(rows), dtype=torch.float32)
        if form.layers == 1:
            return None
        for part in self._parts:
            last = first + (part.rows if part.live is None else len(part.live))
            here = ((rows >= first) & (rows < last)).nonzero()[:, 0]
            at = (rows[here] - first).numpy()
            at = at if part.live is None else part.live[at]
            codes = np.concatenate([layer[at] for layer in part.codes[name]], 2)
            found[here] = form.scan([query], codes, len(at), sweep)[0]
            first = last
        return found

    def mean(self, name: str, sequences: Sequence[str]) -> Tensor:
        """The mean of the frames of some sequences by one channel, see `search.sums.sums`."""
        column, found, first = self._columns[name], list[tuple[npt.NDArray[Any], int]](), 0
        for part, counts in zip(self._parts, self._counts, strict=True):
            for sequence in sequences:
                number, frames = part.sums.numbers.get(sequence), counts.get(sequence, 0)
                if number is None or not frames:
                    continue
                if frames == part.sums.frames[number]:
                    found.append(part.sums.of(sequence, column))
                else:  # some were removed
                    here = self._sequences[first : first + counts.total()] == sequence
                    rows = first + np.flatnonzero(here)
                    found.append(sums(taken(self._database, rows, [column], True)[name]))
            first += counts.total()
        return mean_of(found, column)

    @cached_property
    def _sequences(self) -> npt.NDArray[np.object_]:
        stored = self._database.table().to_table(columns=["sequence"], scan_in_order=True)
        return np.asarray(stored["sequence"].to_pylist(), dtype=object)

    @cached_property
    def _counts(self) -> list[Counter[str]]:
        """The frames of each sequence in each data file."""
        counts, first = list[Counter[str]](), 0
        for part in self._parts:
            rows = part.rows if part.live is None else len(part.live)
            counts.append(Counter(self._sequences[first : first + rows].tolist()))
            first += rows
        return counts


class _Part(NamedTuple):
    """The layers of codes of a data file by channel, the sums of its sequences, its rows, and those
    that are not removed, ``None`` for all."""

    codes: Mapping[str, list[Codes]]
    sums: Sums
    rows: int
    live: npt.NDArray[np.int64] | None = None


def _folder(database: Database) -> Path:
    return path_within(Path(database.path), FOLDER, FOLDER)


def _files(folder: Path) -> list[Path]:
    """The files of an index in the folder of what it was made by."""
    return [file for file in folder.iterdir() if re.fullmatch(_FILE, file.name)]


def _columns(database: Database) -> list[list[Any]]:
    return [[*column[:2], list(column.shape), column.dtype] for column in database.columns]


class _Learnt(NamedTuple):
    """What an index was made of: its folder, the number of rows and the columns then, the coarse
    form of each channel, and the sample."""

    folder: Path
    rows: int
    columns: list[list[Any]]
    forms: dict[str, Coarse]
    sample: dict[str, Tensor]


def _learnt(database: Database) -> _Learnt | None:
    """What the index was made of; ``None`` without one, and for a damaged one."""
    folder = _folder(database)
    try:
        with input_errors(folder, "no index"):
            about = read_json(folder / _ABOUT)
            folder = path_within(folder, about["folder"], _LEARNT_FOLDER)
            arrays, sample = (read_npz(folder / name) for name in (_LEARNT, _SAMPLED))
            if about["format"] != _FORMAT:
                return None
            forms = {}
            for column in database.columns:
                prefix = f"{column.name}."
                own = {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
                forms[column.name] = coarse.of(column, own)
            columns = database.columns
            known = {column.name: torch.from_numpy(sample[column.name]) for column in columns}
    except (OSError, ValueError):
        return None
    return _Learnt(folder, about["rows"], about["columns"], forms, known)


def _learn(database: Database) -> _Learnt:
    """Chooses a sample of the rows, and learns the coarse forms from it. Codes stand beside what
    they were made by, so that those of two processes are not mixed."""
    folder, rows, columns = _folder(database), len(database), database.columns
    own = folder / secrets.token_hex(4)
    own.mkdir(parents=True)
    size = sum(math.prod(column.shape) * np.dtype(column.dtype).itemsize for column in columns)
    count = min(rows, _SAMPLE, max(1, _SAMPLE_BYTES // size))
    chosen = np.random.default_rng(0).choice(rows, count, replace=False)
    found = taken(database, np.sort(chosen), columns, verified=True)
    forms = {column.name: coarse.learn(column, found[column.name]) for column in columns}
    arrays = {f"{name}.{key}": a for name, form in forms.items() for key, a in form.learnt.items()}
    for file, content in ((_LEARNT, arrays), (_SAMPLED, found)):
        values: dict[str, Any] = {name: np.asarray(each) for name, each in content.items()}
        with replacing(own / file) as part, part.open("wb") as stream:
            np.savez(stream, **values)
    about = {"format": _FORMAT, "folder": own.name, "rows": rows, "columns": _columns(database)}
    with replacing(path_within(folder, _ABOUT, ".+")) as part:
        part.write_text(json.dumps(about))
    return _Learnt(own, rows, _columns(database), forms, found)


def _remove_others(folder: Path) -> None:
    """Removes the files of earlier indexes, which are in folders beside the present one."""
    for other in folder.parent.iterdir():
        if re.fullmatch(_LEARNT_FOLDER, other.name) and not other.is_symlink() and other != folder:
            with suppress(OSError):  # also a folder that is not empty then
                for file in _files(other):
                    file.unlink()
                other.rmdir()


def taken(
    database: Database,
    rows: npt.NDArray[np.int64],
    columns: Sequence[Column],
    verified: bool = False,
) -> dict[str, Tensor]:
    """The descriptors ``(N, *shape)`` of rows by channel; ``verified`` checks their bytes."""
    table = database.table()
    names = table.schema.names if verified else [column.name for column in columns]
    with lance_errors(ValueError, f"{database.path} is damaged"):
        found = table.take(rows.tolist(), columns=names)
    if verified and not intact(found).all():
        raise ValueError(f"{database.path} is damaged; ssrvlad db verify shows where")
    return {column.name: descriptors(found[column.name], column) for column in columns}


def descriptors(values: pa.ChunkedArray | pa.Array, column: Column) -> Tensor:
    """``(N, *shape)``, a copy."""
    return torch.from_numpy(matrix(values).copy()).view(-1, *column.shape)


def _part(
    fragment: LanceFragment, forms: Mapping[str, Coarse], columns: Sequence[Column], folder: Path
) -> _Part | None:
    """What the index holds of a data file, memory-mapped; ``None`` unless all is there, whole."""
    codes: dict[str, list[Codes]] = {column.name: [] for column in columns}
    for column, layer in _layers(forms, columns):
        try:
            array = np.load(_file(folder, fragment, column.name, layer), mmap_mode="r")
        except (OSError, ValueError) as error:
            refuse_many_files(error)
            return None
        expected = _shape(fragment, column, forms[column.name], layer)
        if (array.shape, array.dtype) != expected or not array.flags.c_contiguous:
            return None
        codes[column.name].append(array)
    known = Sums.read(folder / _stem(fragment), columns)
    return None if known is None else _Part(codes, known, fragment.physical_rows)


def _checksums(stem: Path) -> Path:
    """Holds the CRC-32 of the files of a data file."""
    return path_within(stem.parent, f"{stem.name}.checksums.json", _FILE)


def _damaged(stem: Path) -> list[Path] | None:
    """The files of a data file that are not as they were written; ``None`` if they were not."""
    try:
        checksums = read_json(_checksums(stem))
        paths = {path_within(stem.parent, name, _FILE): checksums[name] for name in checksums}
        return [path for path, checksum in paths.items() if _crc(path) != checksum]
    except FileNotFoundError:
        return None
    except (ValueError, TypeError):
        return [stem.with_name(f"{stem.name}.checksums.json")]


def _crc(path: Path) -> int:
    value = 0
    with suppress(FileNotFoundError), path.open("rb") as file:
        while block := file.read(_BLOCK << 8):
            value = zlib.crc32(block, value)
    return value


def _layers(forms: Mapping[str, Coarse], columns: Sequence[Column]) -> list[tuple[Column, int]]:
    return [(column, layer) for column in columns for layer in range(forms[column.name].layers)]


def _shape(
    fragment: LanceFragment, column: Column, form: Coarse, layer: int
) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype of a layer of codes of a data file by one channel."""
    none = form.codes(torch.from_numpy(column.zeros(0)), layer)
    return (-(-fragment.physical_rows // form.together), *none.shape[1:]), none.dtype


def _write(
    fragment: LanceFragment, forms: Mapping[str, Coarse], columns: Sequence[Column], folder: Path
) -> None:
    """Writes the codes and the sums of a data file."""
    names = np.full(fragment.physical_rows, "", dtype=object)
    stored = fragment.to_table(columns=["sequence"], with_row_address=True)
    offsets = (stored["_rowaddr"].to_numpy() & _OFFSET).astype(np.int64)
    names[offsets] = stored["sequence"].to_pylist()
    with ExitStack() as stack:
        add = stack.enter_context(writing_sums(folder / _stem(fragment), columns, names.tolist()))
        streams = {}
        for column, layer in _layers(forms, columns):
            part = stack.enter_context(replacing(_file(folder, fragment, column.name, layer)))
            streams[column, layer] = stream = stack.enter_context(part.open("wb"))
            shape, dtype = _shape(fragment, column, forms[column.name], layer)
            about = {"shape": shape, "fortran_order": False, "descr": dtype.str}
            npy.write_array_header_1_0(stream, about)
        for batch in _whole_blocks(fragment, columns):
            add(batch)
            for (column, layer), stream in streams.items():
                stream.write(forms[column.name].codes(batch[column.name], layer).tobytes())
    stem = folder / _stem(fragment)
    written = {
        file.name: _crc(file)
        for file in _files(folder)
        if file.name.startswith(f"{stem.name}.") and file.suffix != ".json"
    }
    with replacing(_checksums(stem)) as part:
        part.write_text(json.dumps(written))


def _whole_blocks(
    fragment: LanceFragment, columns: Sequence[Column]
) -> Iterator[dict[str, Tensor]]:
    """The descriptors of a data file by channel, `_BLOCK` rows at a time, and less at the end; zero
    for removed rows. Damage is a ValueError."""
    live = fragment.to_table(columns=[], with_row_address=True)["_rowaddr"].to_numpy()
    offsets, rows = (live & _OFFSET).astype(np.int64), fragment.physical_rows
    damage: list[Damage] = []
    start = done = 0

    def fresh() -> dict[str, Tensor]:
        size = min(_BLOCK, rows - start)
        return {c.name: torch.from_numpy(c.zeros(size)) for c in columns}

    block = fresh()
    for batch in read_intact(fragment, damage):
        at, first = offsets[done : done + len(batch)], 0
        done += len(batch)
        while first < len(batch):
            last = int(np.searchsorted(at, start + _BLOCK))
            for column in columns:
                values = descriptors(batch[column.name].slice(first, last - first), column)
                block[column.name][torch.from_numpy(at[first:last] - start)] = values
            first = last
            if first < len(batch):
                yield block
                start += _BLOCK
                block = fresh()
    if damage:
        raise ValueError(f"{damage[0].file} is damaged: {damage[0].reason}")
    while start < rows:
        yield block
        start += _BLOCK
        block = fresh() if start < rows else {}


def _stem(fragment: LanceFragment) -> str:
    """The name of the data file of a fragment."""
    return Path(fragment.metadata.files[0].path).stem


def _file(folder: Path, fragment: LanceFragment, name: str, layer: int) -> Path:
    return path_within(folder, f"{_stem(fragment)}.{layer}.{name}.npy", _FILE)
