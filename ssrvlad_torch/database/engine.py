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
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from ..files import flush
from .written import check_data, check_deletions

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import FragmentMetadata

_ATTEMPTS, _PAUSE = 100, 0.02
_COUNT = (1 << 64) - 1
_MESSAGE = "lance.commit.message"
_CHANGES = {
    "Overwrite": "create",
    "UpdateConfig": "add an origin",
    "CreateIndex": "index",
    "Rewrite": "compact",
}


def lance() -> Any:
    """The module, imported when it is first needed; its log stays out of the user's terminal."""
    os.environ.setdefault("LANCE_LOG", "error")
    import lance as module
    import lance.commit
    import lance.optimize

    return module


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


def newest_readable(uri: str) -> tuple[int | None, list[Path]]:
    """The newest version of a folder that can be read, and the manifests of those after it."""
    unreadable: list[Path] = []
    for file in sorted(Path(uri, "_versions").glob("*.manifest")):  # named by the steps to 2^64
        version = _COUNT - int(file.stem)
        try:
            opened(uri, version)
        except OSError:
            unreadable.append(file)
        else:
            return version, unreadable
    return None, unreadable


def put_aside(uri: str) -> list[str]:
    """Renames the newest manifests that cannot be read, if one before them can; their names."""
    last, files = newest_readable(uri)
    if last is None or not files:
        return []
    for file in files:
        file.rename(Path(uri, f"damaged-{file.name}"))
    sync(uri, [], ["_versions"])
    return [file.name for file in files]


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
        OSError: it cannot be written.
    """
    try:
        yield
    except (OSError, RuntimeError, lance().commit.CommitConflictError) as error:
        raise OSError(f"{uri} cannot be written: {one_line(error)}") from error


def changed(uri: str, change: Callable[[LanceDataset], LanceDataset]) -> LanceDataset:
    """A table after a change, made anew for as long as others commit theirs before it.

    Raises:
        OSError: it cannot be written, or others keep writing; and what the change raises.
    """
    for attempt in range(_ATTEMPTS):
        try:
            with writing(uri):
                return change(opened(uri))
        except OSError as error:
            if not re.search("conflict|concurrent", str(error).replace(uri, ""), re.IGNORECASE):
                raise
        time.sleep(random.uniform(0, _PAUSE * min(attempt + 1, 10)))
    raise OSError(f"{uri} cannot be written: {_ATTEMPTS} times others were first")


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


def add_metadata(uri: str, entries: dict[str, str]) -> LanceDataset:
    """Adds entries to a table's metadata."""

    def change(table: LanceDataset) -> LanceDataset:
        if not {key.decode() for key in table.schema.metadata}.issuperset(entries):
            table.update_schema_metadata({**entries})
            sync_version(table)
        return table

    return changed(uri, change)


def compact(uri: str, keep: timedelta) -> LanceDataset:
    """Joins small files and forgets versions older than ``keep``."""

    def change(table: LanceDataset) -> LanceDataset:
        compaction = lance().optimize.Compaction
        plan = compaction.plan(table, lance().optimize.CompactionOptions())
        done = [task.execute(table) for task in plan.tasks]
        sync(uri, [fragment for task in done for fragment in task.new_fragments])
        compaction.commit(table, done)
        opened(uri).optimize.optimize_indices()
        table = opened(uri)
        sync_version(table)
        table.cleanup_old_versions(older_than=keep)
        return table

    return changed(uri, change)


def create_index(uri: str, column: str, kind: str, lists: int, **options: Any) -> LanceDataset:
    """Builds an index of a column for cosines, in the place of what is there."""
    options |= {"metric": "cosine", "replace": True, "num_partitions": lists}

    def change(table: LanceDataset) -> LanceDataset:
        table.create_index(column, kind, **options)
        table = opened(uri)
        sync_version(table)
        return table

    return changed(uri, change)


def write_fragments(
    table: LanceDataset, rows: pa.Table | pa.RecordBatchReader
) -> list[FragmentMetadata]:
    """Rows as data files that are on the disk, and that no version names yet."""
    fragments: list[FragmentMetadata] = lance().fragment.write_fragments(
        rows, table.uri, schema=table.schema, mode="append"
    )
    sync(table.uri, fragments)
    return fragments


def described(fragments: Iterable[FragmentMetadata]) -> tuple[str, ...]:
    """Fragments in JSON, for `substitution` in another process."""
    return tuple(json.dumps(fragment.to_json()) for fragment in fragments)


def substitution(table: LanceDataset, ids: pa.Table | None, written: Iterable[str]) -> Any:
    """The operation that removes the rows of ids, if any, and adds fragments `described`."""
    made = [lance().FragmentMetadata.from_json(text) for text in written]
    if ids is None:
        return lance().LanceOperation.Update(new_fragments=made)
    removal: Any = table.merge_insert("frame").when_matched_delete().execute_uncommitted(ids)[0]
    return dataclasses.replace(removal.operation, new_fragments=made)


def commit(uri: str, plan: Callable[[LanceDataset], Any], message: str) -> LanceDataset:
    """One change of rows. No two are made of one version, so that no id is added twice.

    Args:
        uri: of the table.
        plan: makes the operation for one version of the table, ``None`` if there is nothing to do.
        message: what `message_of` tells of it.
    """

    def change(before: LanceDataset) -> LanceDataset:
        operation = plan(before)
        if operation is None:
            return before
        sync(uri, operation.updated_fragments)
        transaction = lance().Transaction(
            before.version,
            _exclusive(before, operation),
            uuid=str(uuid.uuid4()),
            transaction_properties={_MESSAGE: message},
        )
        after: LanceDataset = lance().LanceDataset.commit(uri, transaction, max_retries=0)
        sync_version(after, transaction)
        return after

    return changed(uri, change)


def message_of(table: LanceDataset, version: int) -> str:
    """What was done to make a version."""
    transaction = table.read_transaction(version)
    if transaction is None:
        return ""
    said = (transaction.transaction_properties or {}).get(_MESSAGE)
    operation = type(transaction.operation).__name__
    return said or _CHANGES.get(operation, operation.lower())


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


def check_written(uri: str, fragment: FragmentMetadata) -> list[Path]:
    """The files of a fragment, which are whole."""
    paths = []
    for file in fragment.files:
        paths.append(Path(uri, "data", file.path))
        check_data(paths[-1], file)
    if deletions := fragment.deletion_file:
        paths.append(Path(uri, deletions.path(fragment.id)))
        check_deletions(paths[-1], deletions)
    return paths


def sync_version(table: LanceDataset, transaction: Any = None) -> None:
    """Puts on the disk what makes the version of a table count."""
    names = [f"_versions/{_COUNT - table.version}.manifest"]
    if transaction is not None:
        folder = Path(table.uri, "_transactions")  # its file is named by the version it came after
        names += [f"_transactions/{file.name}" for file in folder.glob(f"*-{transaction.uuid}.txn")]
    sync(table.uri, [], names)


def sync(uri: str, fragments: Iterable[FragmentMetadata], names: Iterable[str] = ()) -> None:
    """Puts files of a table and the folders that they are in on the disk, and sees that they are
    whole; an object store needs it not.

    Raises:
        OSError: the disk refused, now or while Lance wrote them.
    """
    if not is_local(uri):
        return
    files = [Path(uri, name) for name in names]
    for fragment in fragments:
        files += check_written(uri, fragment)
    for file in files:
        flush(file)
    for folder in {parent for file in files for parent in (file.parent, Path(uri))}:
        flush(folder)
