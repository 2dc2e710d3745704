"""What is between a `Database` and Lance: opening, committing, and putting files on the disk.

Lance writes files and names them in a manifest, but does not flush them. Here the data files are
flushed before the commit that names them, the manifest and the folders after it.

Lance's threads do not survive a fork: a process that has used it must start others by spawn, or
fork before.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import random
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from ..files import flush

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import FragmentMetadata

_ATTEMPTS = 100
_PAUSE = 0.02
_COUNT = (1 << 64) - 1
_MESSAGE = "lance.commit.message"

Plan = Callable[["LanceDataset"], Any]
"""Makes an operation of Lance for one version of a table, or ``None`` if there is nothing to do."""


def lance() -> Any:
    """The module, imported when it is first needed; its log stays out of the user's terminal."""
    os.environ.setdefault("LANCE_LOG", "error")
    import lance as module
    import lance.commit
    import lance.optimize

    return module


def _wait(attempt: int) -> None:
    time.sleep(random.uniform(0, _PAUSE * min(attempt + 1, 10)))


def opened(uri: str, version: int | None = None) -> LanceDataset:
    """A table at a version, without one the newest.

    Raises:
        OSError: there is none, or it is damaged.
    """
    try:
        table: LanceDataset = lance().dataset(uri, version=version)
    except ValueError as error:
        raise OSError(one_line(error)) from error
    return table


def last_readable(uri: str) -> int | None:
    """The newest version of a folder whose manifest can be read, ``None`` if there is none."""
    return next((n for n, _ in _manifests(uri) if _is_readable(uri, n)), None)


def put_aside(uri: str) -> list[str]:
    """Renames the newest manifests that cannot be read, if one before them can; their names."""
    last, names = last_readable(uri), []
    for number, file in _manifests(uri) if last is not None else ():
        if number > (last or 0):
            file.rename(Path(uri, f"damaged-{file.name}"))
            names.append(file.name)
    if names:
        flush(Path(uri, "_versions"))
        flush(Path(uri))
    return names


def _manifests(uri: str) -> list[tuple[int, Path]]:
    """The versions of a folder, the newest first; their names count down from 2^64."""
    files = Path(uri, "_versions").glob("*.manifest") if is_local(uri) else ()
    return sorted(((_COUNT - int(file.stem), file) for file in files), reverse=True)


def _is_readable(uri: str, version: int) -> bool:
    try:
        opened(uri, version)
    except OSError:
        return False
    return True


def is_local(uri: str) -> bool:
    """Whether a table is a folder of this machine, and not an object store's."""
    return "://" not in uri


def one_line(error: BaseException) -> str:
    """What an error of Lance says, without the place in its source."""
    return " ".join(str(error).split()).split(", /")[0] or type(error).__name__


@contextlib.contextmanager
def writing(uri: str) -> Iterator[None]:
    """Names the table in the errors of the disk.

    Raises:
        OSError: it cannot be written, or others keep writing.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise OSError(f"{uri} cannot be written: {one_line(error)}") from error


def change(table: LanceDataset, version: int) -> str:
    """What was done to make a version."""
    transaction = table.read_transaction(version)
    if transaction is None:
        return ""
    said = (transaction.transaction_properties or {}).get(_MESSAGE)
    return said or type(transaction.operation).__name__.lower()


def write_fragments(table: LanceDataset, rows: pa.Table) -> list[FragmentMetadata]:
    """Rows as data files that no version names yet."""
    if not len(rows):
        return []
    fragments: list[FragmentMetadata] = lance().fragment.write_fragments(
        rows, table.uri, schema=table.schema, mode="append"
    )
    return fragments


def write_apart(table: LanceDataset, rows: pa.Table) -> tuple[str, ...]:
    """Rows as data files that are on the disk, described in JSON for `addition`."""
    with writing(table.uri):
        fragments = write_fragments(table, rows)
        sync(table.uri, [name for fragment in fragments for name in file_names(fragment)])
    return tuple(json.dumps(fragment.to_json()) for fragment in fragments)


def substitution(table: LanceDataset, ids: pa.Table | None, described: Iterable[str]) -> Any:
    """The operation that removes the rows of ids, if any, and adds what `write_apart` wrote."""
    made = [lance().FragmentMetadata.from_json(text) for text in described]
    if ids is None:
        return lance().LanceOperation.Update(new_fragments=made)
    removal: Any = table.merge_insert("frame").when_matched_delete().execute_uncommitted(ids)[0]
    return dataclasses.replace(removal.operation, new_fragments=made)


def add_metadata(uri: str, entries: dict[str, str]) -> LanceDataset:
    """Adds entries to a table's metadata."""
    for attempt in range(_ATTEMPTS):
        table = opened(uri)
        there = {key.decode() for key in table.schema.metadata}
        if there.issuperset(entries):
            return table
        try:
            table.update_schema_metadata({**entries})
        except OSError as error:
            if "oncurrent" not in str(error):
                raise OSError(f"{uri} cannot be written: {one_line(error)}") from error
            _wait(attempt)
            continue
        sync_version(table)
        return table
    raise OSError(f"{uri} cannot be written: {_ATTEMPTS} times others were first")


def compact(uri: str, keep: timedelta) -> LanceDataset:
    """Joins small files and forgets versions older than ``keep``."""
    for attempt in range(_ATTEMPTS):
        table = opened(uri)
        compaction = lance().optimize.Compaction
        with writing(uri):
            plan = compaction.plan(table, lance().optimize.CompactionOptions())
            done = [task.execute(table) for task in plan.tasks]
            sync(uri, [name for task in done for f in task.new_fragments for name in file_names(f)])
            try:
                compaction.commit(table, done)
                table = opened(uri)
                table.optimize.optimize_indices()
            except (lance().commit.CommitConflictError, OSError) as error:
                if "conflict" not in str(error):
                    raise
                _wait(attempt)
                continue
            table = opened(uri)
            sync_version(table)
            table.cleanup_old_versions(older_than=keep)
        return table
    raise OSError(f"{uri} cannot be written: {_ATTEMPTS} times others were first")


def create_index(uri: str, column: str, kind: str, lists: int) -> LanceDataset:
    """Builds an index of a column for cosines, in the place of what is there."""
    with writing(uri):
        opened(uri).create_index(column, kind, metric="cosine", replace=True, num_partitions=lists)
        table = opened(uri)
        sync_version(table)
    return table


def create(uri: str, schema: pa.Schema) -> LanceDataset:
    """A new, empty table."""
    with writing(uri):
        if is_local(uri):
            Path(uri).mkdir(parents=True, exist_ok=True)
        table: LanceDataset = lance().write_dataset(
            schema.empty_table(), uri, schema=schema, mode="create"
        )
        sync_version(table)
        if is_local(uri):
            flush(Path(uri).absolute().parent)
    return table


def commit(uri: str, plan: Plan, message: str) -> LanceDataset:
    """One change of rows, made anew for as long as others commit theirs before it.

    No two are made of one version, so that no id is added twice.

    Args:
        uri: of the table.
        plan: makes the operation; where it raises, nothing has changed.
        message: what `versions` tells of it.

    Returns:
        The table after it.
    """
    for attempt in range(_ATTEMPTS):
        with writing(uri):
            before = opened(uri)
            operation = plan(before)
        if operation is None:
            return before
        with writing(uri):
            _sync_data(uri, operation)
            transaction = lance().Transaction(
                before.version,
                _exclusive(before, operation),
                uuid=str(uuid.uuid4()),
                transaction_properties={_MESSAGE: message},
            )
            try:
                after: LanceDataset = lance().LanceDataset.commit(uri, transaction, max_retries=0)
            except lance().commit.CommitConflictError:
                _wait(attempt)
                continue
            sync_version(after, transaction)
        return after
    raise OSError(f"{uri} cannot be written: {_ATTEMPTS} times others were first")


def _exclusive(table: LanceDataset, operation: Any) -> Any:
    """An operation that adds fragments, such that no other can be committed beside it.

    Lance lets two additions of one version pass. Two that touch one fragment conflict: every one
    claims the first fragment. What comes into an empty table takes its place, which `commit` lets
    only happen to the version that was read.
    """
    fragments = table.get_fragments()
    if not fragments:
        return lance().LanceOperation.Overwrite(table.schema, operation.new_fragments)
    oldest = fragments[0].metadata
    touched = {*operation.removed_fragment_ids, *(f.id for f in operation.updated_fragments)}
    claimed = [] if oldest.id in touched else [oldest]
    return dataclasses.replace(
        operation, updated_fragments=[*operation.updated_fragments, *claimed]
    )


def file_names(fragment: FragmentMetadata) -> list[str]:
    """The files of a fragment, below the table's folder."""
    names = [f"data/{file.path}" for file in fragment.files]
    if fragment.deletion_file is not None:
        names.append(str(fragment.deletion_file.path(fragment.id)))
    return names


def _sync_data(uri: str, operation: Any) -> None:
    """Puts on the disk what an operation is about to name."""
    fragments = [
        *getattr(operation, "new_fragments", ()), *getattr(operation, "updated_fragments", ())
    ]  # fmt: skip
    sync(uri, [name for fragment in fragments for name in file_names(fragment)])


def sync_version(table: LanceDataset, transaction: Any = None) -> None:
    """Puts on the disk what makes the version of a table count."""
    names = [f"_versions/{_COUNT - table.version}.manifest"]
    if transaction is not None:
        folder = Path(table.uri, "_transactions")  # its file is named by the version it came after
        names += [f"_transactions/{file.name}" for file in folder.glob(f"*-{transaction.uuid}.txn")]
    sync(table.uri, names)


def sync(uri: str, names: list[str]) -> None:
    """Flushes files of a table and the folders that they are in; an object store needs it not."""
    if not is_local(uri):
        return
    files = [Path(uri, name) for name in names]
    for file in files:
        flush(file)
    for folder in {parent for file in files for parent in (file.parent, Path(uri))}:
        flush(folder)
