"""The operations of Lance that a `Database` uses, each made durable.

Data files are flushed before the commit that refers to them; the manifest and the folders are
flushed after it, see `disk`.

Lance does not survive a fork: a process that was forked after Lance was used may crash or hang in
it, so `lance` and `require_unforked` refuse it there.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import random
import re
import shutil
import time
import traceback
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime, timedelta
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from ..files import flush, is_uri
from .disk import (
    Lease,
    flush_files,
    flush_fragments,
    has_leases,
    hold,
    local_versions,
    manifest,
    take_lease,
)

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import FragmentMetadata

_ATTEMPTS, _PAUSE = 100, 0.02
_LEAST_OPEN_FILES = 64
_OPENINGS = 10
_DELETED_FILE = r"/_\w+/[\w-]+\.\w+ .*not found"
_GRACE = timedelta(hours=1)
"""How long after the next one a version is kept where its use cannot be seen."""
_MESSAGE = "lance.commit.message"
_CHANGES = {
    "Overwrite": "create",
    "UpdateConfig": "add an origin",
    "CreateIndex": "index",
    "Rewrite": "compact",
}


def lance() -> Any:
    """The module, with only errors logged. If so few files can be open that it would panic, an
    OSError; other errors as for `require_unforked`."""
    with contextlib.suppress(ImportError):  # Windows has no such limit
        import resource

        most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        if 0 <= most < _LEAST_OPEN_FILES:
            raise OSError(
                errno.EMFILE,
                f"a database needs {_LEAST_OPEN_FILES} open files, the limit is {most} (ulimit -n)",
            )
    require_unforked()
    os.environ.setdefault("LANCE_LOG", "error")
    warnings.filterwarnings("ignore", "lance is not fork-safe")  # it is refused
    import lance as module
    import lance.commit
    import lance.optimize

    return module


def require_unforked() -> None:
    """Raises RuntimeError in a process that was forked after Lance was used."""
    if _first_user() != os.getpid():
        raise RuntimeError(
            "this process was forked after a database was used, and cannot read or write one: load "
            "the frames before the fork, or open the database in processes that are spawned, as by "
            'DataLoader(multiprocessing_context="spawn")'
        )


_first_user = cache(os.getpid)
"""The process that used Lance first: this one, or the one it was forked from."""


def open_table(uri: str, version: int | None = None) -> LanceDataset:
    """Opens a table at a version, by default the newest, and holds the version while the object
    lives; raises OSError if it is not readable."""
    dataset = lance().dataset
    for attempts_left in reversed(range(_OPENINGS if version is None else 1)):
        try:  # the newest version may be an old one, and deleted, before it is opened
            table: LanceDataset = dataset(uri, version=version)
        except (OSError, ValueError, OverflowError) as error:
            message = message_of(error)
            if attempts_left and re.search(_DELETED_FILE, message, re.IGNORECASE):
                continue
            if isinstance(error, OSError):
                raise
            raise OSError(message) from error
        if hold(table):
            return table
    raise OSError(f"version {version or table.version} was deleted")


def newest_readable(uri: str) -> tuple[int | None, list[str]]:
    """The newest version of a local table that can be read, and the manifests of later ones."""
    unreadable: list[str] = []
    for version in reversed(local_versions(uri)):
        try:
            open_table(uri, version)
        except OSError:
            unreadable.append(f"_versions/{manifest(uri, version).name}")
        else:
            return version, unreadable
    return None, unreadable


def message_of(error: BaseException) -> str:
    """The message of an error of Lance in one line, without XML and the path of Lance's source."""
    line = " ".join(str(error).split())
    return re.split(r", /|: <\?xml", line)[0] or type(error).__name__


@contextlib.contextmanager
def writing(uri: str) -> Iterator[None]:
    """Turns errors of writing into an OSError that names the table."""
    errors: tuple[type[Exception], ...] = (OSError, RuntimeError)
    require_unforked()
    try:
        errors += (lance().commit.CommitConflictError,)
        yield
    except errors as error:
        raise OSError(f"{uri} cannot be written: {message_of(error)}") from error


def change_table(uri: str, change: Callable[[LanceDataset], LanceDataset]) -> LanceDataset:
    """Applies a change to the newest version of a table; again if another writer was faster. An
    OSError if that happens too often or the table cannot be written."""
    for attempt in range(_ATTEMPTS):
        try:
            with writing(uri):
                table = change(open_table(uri))
                return table if hold(table) else open_table(uri)
        except OSError as error:
            if not re.search("conflict|concurrent", str(error).replace(uri, ""), re.IGNORECASE):
                raise
        time.sleep(random.uniform(0, _PAUSE * min(attempt + 1, 10)))
    raise OSError(f"{uri} cannot be written: other writers were faster {_ATTEMPTS} times")


def create(uri: str, schema: pa.Schema) -> LanceDataset:
    """Creates an empty table."""
    with writing(uri):
        if not is_uri(uri):
            Path(uri).mkdir(parents=True, exist_ok=True)
        table: LanceDataset = lance().write_dataset(
            schema.empty_table(), uri, schema=schema, mode="create"
        )
        _flush_version(table)
        if not is_uri(uri):
            flush(Path(uri).absolute().parent)
    return table


def discard_empty(uri: str, error: BaseException | None) -> None:
    """After an error, deletes a local table that has no rows and that nobody else uses. The error's
    traceback is cleared of local variables, which may hold versions."""
    while error:
        traceback.clear_frames(error.__traceback__)
        error = error.__cause__ or error.__context__
    versions = local_versions(uri)
    leases = [has_leases(uri) and take_lease(uri, v, exclusive=True) for v in versions]
    if not (leases and all(leases)):
        return
    with contextlib.suppress(OSError, ValueError):
        newest = lance().dataset(uri)
        if newest.version in versions and not newest.count_rows():
            folder = Path(uri).resolve()
            shutil.rmtree(folder, ignore_errors=True)
            if Path(uri).is_symlink():
                folder.mkdir(exist_ok=True)


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
    done = [task.execute(table) for task in plan.tasks]
    flush_fragments(uri, [fragment for task in done for fragment in task.new_fragments])
    compaction.commit(table, done)
    table = open_table(uri)
    _flush_version(table)
    return table


def clean(uri: str, keep: timedelta) -> None:
    """Deletes versions older than ``keep``, up to the first one that is in use. Later ones stay: a
    writer compares its change with them."""
    leases, old, now = list[Lease](), list[int](), datetime.now()
    with writing(uri):
        table = open_table(uri)
        for before, after in pairwise(versions_of(table)):
            if now - before["timestamp"] < keep:
                break
            if has_leases(uri):
                lease = take_lease(uri, before["version"], exclusive=True)
                if lease is None:
                    break
                leases.append(lease)
            elif now - after["timestamp"] < _GRACE:
                break
            old.append(before["version"])
        if old:
            table.cleanup_old_versions(versions=old)


def versions_of(table: LanceDataset) -> list[Any]:
    """The versions that are stored, as Lance describes them, the oldest first."""
    for _ in range(_OPENINGS):
        with contextlib.suppress(OSError, ValueError):  # one was just deleted
            return list(table.versions())
    return list(table.versions())


def write_fragments(
    table: LanceDataset, rows: pa.Table | pa.RecordBatchReader
) -> list[FragmentMetadata]:
    """Writes rows to data files that no version refers to yet."""
    fragments: list[FragmentMetadata] = lance().fragment.write_fragments(
        rows, table.uri, schema=table.schema, mode="append"
    )
    flush_fragments(table.uri, fragments)
    return fragments


def replacement(table: LanceDataset, ids: pa.Table | None, fragments: Iterable[str]) -> Any:
    """The operation that removes the rows with ``ids`` and adds fragments, given in JSON."""
    added = [lance().FragmentMetadata.from_json(text) for text in fragments]
    if ids is None:
        return lance().LanceOperation.Update(new_fragments=added)
    removal: Any = table.merge_insert("frame").when_matched_delete().execute_uncommitted(ids)[0]
    return dataclasses.replace(removal.operation, new_fragments=added)


def commit(before: LanceDataset, plan: Callable[[LanceDataset], Any], message: str) -> LanceDataset:
    """A change of a table: commits one change of rows with a message, see `change_of`; ``plan``
    returns the operation for one version of the table, ``None`` if nothing is to be done.

    Of several commits planned on one version only the first succeeds, and the others are planned
    again: so no id is added twice. Lance accepts two operations that only add fragments, but not
    two that update the same fragment, so each updates the first one. An empty table has none, and
    is overwritten, which is allowed only on the version that was read.
    """
    operation = plan(before)
    if operation is None:
        return before
    flush_fragments(before.uri, operation.updated_fragments)
    if fragments := before.get_fragments():
        first, updated = fragments[0].metadata, operation.updated_fragments
        if first.id not in {*operation.removed_fragment_ids, *(f.id for f in updated)}:
            operation = dataclasses.replace(operation, updated_fragments=[*updated, first])
    else:
        operation = lance().LanceOperation.Overwrite(before.schema, operation.new_fragments)
    transaction = lance().Transaction(
        before.version,
        operation,
        uuid=str(uuid.uuid4()),
        transaction_properties={_MESSAGE: message},
    )
    after: LanceDataset = lance().LanceDataset.commit(before.uri, transaction, max_retries=0)
    _flush_version(after, transaction)
    return after


def change_of(table: LanceDataset, version: int) -> str:
    """The message of the commit that made a version."""
    try:
        transaction = table.read_transaction(version)
    except (OSError, ValueError):  # just deleted
        transaction = None
    if transaction is None:
        return ""
    message = (transaction.transaction_properties or {}).get(_MESSAGE)
    operation = type(transaction.operation).__name__
    return message or _CHANGES.get(operation, operation.lower())


def _flush_version(table: LanceDataset, transaction: Any = None) -> None:
    """Flushes the manifest of a table's version and the file of the transaction that made it."""
    files = [manifest(table.uri, table.version)]
    if transaction is not None:
        folder = Path(table.uri, "_transactions")  # file name: version before the commit, and uuid
        files += folder.glob(f"*-{transaction.uuid}.txn")
    flush_files(table.uri, files)
