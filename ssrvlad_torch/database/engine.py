"""The operations of Lance that a `Database` uses, and its errors in one line.

Lance flushes no files, commits files of which not all was written, and lets two writers add one
frame: `flush_fragments`, `_flush_version` and `commit` see to it. In an object store, files are
whole once they are there."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import random
import re
import secrets
import shutil
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from ..files import flush, is_uri, path_within

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import FragmentMetadata

_ATTEMPTS, _PAUSE = 100, 0.02
_LATER = "conflict|concurrent|not found"
"""Errors of a writer whose version is no longer the newest, or was deleted meanwhile."""
_NO_LINKS = "Unable to rename file"
"""Lance renames by hard links, which exFAT and some network drives lack."""
_MESSAGE = "lance.commit.message"
_CHANGES = {"Overwrite": "create", "UpdateConfig": "add an origin", "Rewrite": "compact"}
_LAST_VERSION = (1 << 64) - 1
_BITMAP_WITHOUT_RUNS = 12346
_ARRAY_LIMIT, _BITMAP_BYTES = 4096, 8192


class PanicError(OSError):
    """Lance itself failed, as without threads or open files; called again, it may hang."""


def lance() -> Any:
    """The module. In a process that was forked after Lance was used it would hang or crash: there,
    a RuntimeError (`test_a_process_forked_after_a_database_was_used_is_refused`)."""
    if _first_user() != os.getpid():
        raise RuntimeError(
            "this process was forked after a database was used, and cannot read or write one: load "
            "the frames before the fork, or open the database in processes that are spawned, as by "
            'DataLoader(multiprocessing_context="spawn")'
        )
    os.environ.setdefault("LANCE_LOG", "error")
    warnings.filterwarnings("ignore", "lance is not fork-safe")  # it is refused
    import lance as module
    import lance.commit
    import lance.optimize

    return module


_first_user = cache(os.getpid)
"""The process that used Lance first: this one, or the one it was forked from."""


@contextlib.contextmanager
def lance_errors(kind: type[Exception], problem: str = "", values: bool = True) -> Iterator[None]:
    """Turns an error of Lance, or of Arrow that reads by it, into one of another kind: "PROBLEM:
    REASON" in one line. Without ``values``, a ValueError passes.

    An interrupt while Lance works, which also comes as an error, is a KeyboardInterrupt, and a
    panic of Lance a PanicError. Neither means damage."""
    kinds: tuple[type[Exception], ...] = (OSError, RuntimeError, pa.ArrowException)
    kinds += (lance().commit.CommitConflictError, *((ValueError, OverflowError) * values))
    try:
        yield
    except BaseException as error:
        line, panic = " ".join(str(error).split()), type(error).__name__ == "PanicException"
        if not (isinstance(error, kinds) or panic):
            raise
        if "KeyboardInterrupt" in line:
            raise KeyboardInterrupt from error
        reason = re.split(r", /|: <\?xml", line)[0] or type(error).__name__  # without sources, XML
        if _NO_LINKS in reason:
            reason = "the file system has no hard links, which Lance needs; expected another disk"
        if panic or "Task was aborted" in line:
            raise PanicError(f"Lance failed: {reason}") from error
        raise kind(f"{problem}: {reason}" if problem else reason) from error


def open_table(uri: str, version: int | None = None) -> LanceDataset:
    """A table at a version, by default the newest; an OSError if it is not readable."""
    with lance_errors(OSError):
        table: LanceDataset = lance().dataset(uri, version=version)
    return table


def unreadable(uri: str, version: int | None, error: OSError) -> str:
    """Why a version of a table cannot be opened, and which can, in one line."""
    stored, problem = local_versions(uri), f"{uri} cannot be opened: {error}"
    if version is None:
        for earlier in reversed(stored):
            with contextlib.suppress(OSError):
                open_table(uri, earlier)
                return f"{problem}; --as-of {earlier} reads an earlier version"
        return problem
    with contextlib.suppress(OSError):
        stored = stored or [entry.version for entry in history(open_table(uri))]
    if not stored:
        return problem
    if version in stored:
        return f"{uri} is damaged in version {version}: {error}"
    span = " to ".join(map(str, dict.fromkeys((stored[0], stored[-1]))))
    return f"{uri} has no version {version}; it has {span}"


def local_versions(uri: str) -> list[int]:
    """The stored versions of a local table, the oldest first; none of one in an object store."""
    return sorted(_LAST_VERSION - int(f.stem) for f in Path(uri, "_versions").glob("*.manifest"))


def change_table(uri: str, change: Callable[[LanceDataset], LanceDataset]) -> LanceDataset:
    """Applies a change to the newest version of a table; again if another writer was faster. An
    OSError if that happens too often or the table cannot be written."""
    for attempt in range(_ATTEMPTS):
        try:
            with lance_errors(OSError, f"{uri} cannot be written", values=False):
                return change(open_table(uri))
        except OSError as error:
            if not re.search(_LATER, str(error).replace(uri, ""), re.IGNORECASE):
                raise
        time.sleep(random.uniform(0, _PAUSE * min(attempt + 1, 10)))
    raise OSError(f"{uri} cannot be written: other writers were faster {_ATTEMPTS} times")


def create(uri: str, schema: pa.Schema) -> LanceDataset:
    """Creates an empty table."""
    with lance_errors(OSError, f"{uri} cannot be written"):
        folder = Path(uri)
        is_new = not is_uri(uri) and not folder.exists()
        if not is_uri(uri):
            folder.mkdir(parents=True, exist_ok=True)
        try:
            table: LanceDataset = lance().write_dataset(
                schema.empty_table(), uri, schema=schema, mode="create"
            )
        except OSError as error:
            if is_new and _NO_LINKS in str(error):
                shutil.rmtree(folder, ignore_errors=True)
            raise
        _flush_version(table)
        if not is_uri(uri):
            flush(Path(uri).absolute().parent)
    return table


def discard_empty(uri: str) -> None:
    """Deletes a local table that has no rows; one that cannot be read stays. It is renamed first,
    so that another writer of it fails, and does not lose its rows."""
    if is_uri(uri) or not _is_empty(folder := Path(uri).resolve()):
        return
    apart = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    try:
        with contextlib.suppress(OSError):
            folder.rename(apart)
            if _is_empty(apart):
                shutil.rmtree(apart)
                if Path(uri).is_symlink():
                    folder.mkdir()
    finally:
        if apart.exists():
            apart.rename(folder)


def _is_empty(folder: Path) -> bool:
    """Whether a local table can be read and has no rows."""
    try:
        with lance_errors(OSError):
            rows = open_table(str(folder)).count_rows()
    except OSError:
        return False
    return rows == 0


def add_metadata(table: LanceDataset, entries: dict[str, str]) -> LanceDataset:
    """A change of a table: adds entries to its metadata."""
    if not {key.decode() for key in table.schema.metadata}.issuperset(entries):
        table.update_schema_metadata({**entries})
        _flush_version(table)
    return table


def compact(table: LanceDataset) -> LanceDataset:
    """A change of a table: joins small files."""
    uri, compaction = table.uri, lance().optimize.Compaction
    plan = compaction.plan(table, lance().optimize.CompactionOptions())
    results = [task.execute(table) for task in plan.tasks]
    flush_fragments(uri, [fragment for result in results for fragment in result.new_fragments])
    compaction.commit(table, results)
    table = open_table(uri)
    _flush_version(table)
    return table


def clean(table: LanceDataset, keep: timedelta) -> LanceDataset:
    """A change of a table: deletes versions older than ``keep``."""
    table.cleanup_old_versions(older_than=keep, error_if_tagged_old_versions=False)
    return table


def write_fragments(
    table: LanceDataset, rows: pa.Table | pa.RecordBatchReader
) -> list[FragmentMetadata]:
    """Writes rows to data files that no version refers to yet."""
    fragments: list[FragmentMetadata] = lance().fragment.write_fragments(
        rows, table.uri, schema=table.schema, mode="append"
    )
    flush_fragments(table.uri, fragments)
    return fragments


def replacement(
    table: LanceDataset, ids: pa.Table | None, added: Sequence[FragmentMetadata]
) -> Any:
    """The operation that removes the rows with ``ids`` and adds fragments."""
    if ids is None:
        return lance().LanceOperation.Update(new_fragments=[*added])
    removal: Any = table.merge_insert("frame").when_matched_delete().execute_uncommitted(ids)[0]
    return dataclasses.replace(removal.operation, new_fragments=[*added])


def commit(table: LanceDataset, plan: Callable[[LanceDataset], Any], message: str) -> LanceDataset:
    """A change of a table: commits one change of rows with a message; ``plan``
    returns the operation for one version of the table, ``None`` if nothing is to be done.

    Of several commits planned on one version only the first succeeds, and the others are planned
    again: so no id is added twice. Lance accepts two operations that only add fragments, but not
    two that update the same fragment, so each updates the first one. An empty table has none, and
    is overwritten, which is allowed only on the version that was read."""
    operation = plan(table)
    if operation is None:
        return table
    flush_fragments(table.uri, operation.updated_fragments)
    if fragments := table.get_fragments():
        first, updated = fragments[0].metadata, operation.updated_fragments
        if first.id not in {*operation.removed_fragment_ids, *(f.id for f in updated)}:
            operation = dataclasses.replace(operation, updated_fragments=[*updated, first])
    else:
        operation = lance().LanceOperation.Overwrite(table.schema, operation.new_fragments)
    transaction = lance().Transaction(
        table.version, operation, uuid=str(uuid.uuid4()), transaction_properties={_MESSAGE: message}
    )
    changed: LanceDataset = lance().LanceDataset.commit(table.uri, transaction, max_retries=0)
    _flush_version(changed)
    return changed


class Version(NamedTuple):
    """One version of a database: its number, for `Database.open`, when it was made, the number of
    frames in it, and the change that made it."""

    version: int
    time: datetime
    frames: int
    change: str


def history(table: LanceDataset) -> list[Version]:
    """The versions that are stored, the oldest first."""
    versions, entries = list[Version](), list[Any](table.versions())
    for entry in entries:
        number, change = entry["version"], ""
        if transaction := table.read_transaction(number):
            operation = type(transaction.operation).__name__
            message = (transaction.transaction_properties or {}).get(_MESSAGE)
            change = message or _CHANGES.get(operation, operation.lower())
        frames = int(entry["metadata"]["total_rows"])
        versions.append(Version(number, entry["timestamp"], frames, change))
    return versions


def flush_fragments(uri: str, fragments: Iterable[FragmentMetadata]) -> None:
    """Flushes the files of fragments; an OSError unless a data file has the size, and a file of
    deleted rows the number of rows, that Lance recorded
    (`test_a_writer_loses_nothing_at_any_call`)."""
    if is_uri(uri):
        return
    whole = dict[Path, bool]()
    for fragment in fragments:
        for file in fragment.files:
            path = path_within(Path(uri, "data"), file.path)
            whole[path] = file.file_size_bytes in (None, 0, path.stat().st_size)
        if deletions := fragment.deletion_file:
            path = Path(uri, deletions.path(fragment.id))
            whole[path] = deleted_rows(path) == deletions.num_deleted_rows
    if truncated := [path for path in whole if not whole[path]]:
        reason = f"{os.strerror(errno.EIO)}: not all was written"
        raise OSError(errno.EIO, reason, str(truncated[0]))
    _flush_files(uri, whole)


def deleted_rows(path: Path) -> int | None:
    """The number of rows in a file of deleted rows, of Arrow or a Roaring bitmap without runs
    (RoaringFormatSpec); ``None`` if the file is not whole. Lance records no size of such a file."""
    content = path.read_bytes()
    if path.suffix != ".bin":
        try:
            return int(pa.ipc.open_file(content).read_all().num_rows)
        except pa.ArrowInvalid:
            return None
    if len(content) < 8:
        return None
    cookie, containers = np.frombuffer(content, "<u4", 2).tolist()
    header = 8 + 8 * containers
    if cookie != _BITMAP_WITHOUT_RUNS or len(content) < header:
        return None
    counts = np.frombuffer(content, "<u2", 2 * containers, 8)[1::2].astype(np.int64) + 1
    sizes = np.where(counts <= _ARRAY_LIMIT, 2 * counts, _BITMAP_BYTES)
    return int(counts.sum()) if len(content) == header + sizes.sum() else None


def _flush_version(table: LanceDataset) -> None:
    """Flushes the manifest of a table's version."""
    if not is_uri(table.uri):
        name = f"{_LAST_VERSION - table.version}.manifest"
        _flush_files(table.uri, [Path(table.uri, "_versions", name)])


def _flush_files(uri: str, files: Iterable[Path]) -> None:
    """Flushes files of a local table and the folders that hold them."""
    for file in files:
        flush(file)
    for folder in {parent for file in files for parent in (file.parent, Path(uri))}:
        flush(folder)
