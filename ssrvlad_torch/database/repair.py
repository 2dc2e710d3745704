"""Repair of a damaged table: damaged manifests are put aside, damaged rows are dropped."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from .disk import flush_files
from .engine import lance, manifests, open_table, write_fragments
from .reading import Damage, read_intact

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import LanceFragment


def newest_readable(uri: str) -> tuple[int | None, list[Path]]:
    """The newest version of a local table that can be read, and the manifests of later ones."""
    unreadable: list[Path] = []
    for version, file in manifests(uri).items():
        try:
            open_table(uri, version)
        except OSError:
            unreadable.append(file)
        else:
            return version, unreadable
    return None, unreadable


def put_manifests_aside(uri: str) -> list[str]:
    """Renames the newest manifests if they cannot be read and an earlier one can.

    Returns:
        Their names.
    """
    last, files = newest_readable(uri)
    if last is None or not files:
        return []
    for file in files:
        file.rename(Path(uri, f"damaged-{file.name}"))
    flush_files(uri, [Path(uri, "_versions")])
    return [file.name for file in files]


def replacement_of_damaged(table: LanceDataset, damage: list[Damage]) -> Any:
    """The operation that replaces damaged fragments by their intact rows, ``None`` if there is no
    damage.

    Args:
        table: the version that is read.
        damage: set to what is damaged.
    """
    damage.clear()
    damaged = [fragment for fragment in table.get_fragments() if _is_damaged(fragment, damage)]
    if not damaged:
        return None
    intact = (batch for fragment in damaged for batch in read_intact(fragment, []))
    rows = pa.RecordBatchReader.from_batches(table.schema, intact)
    return lance().LanceOperation.Update(
        removed_fragment_ids=[fragment.fragment_id for fragment in damaged],
        new_fragments=write_fragments(table, rows),
    )


def _is_damaged(fragment: LanceFragment, damage: list[Damage]) -> bool:
    """Whether a fragment is damaged; its damage is appended to ``damage``."""
    before = len(damage)
    for _ in read_intact(fragment, damage):
        pass
    return len(damage) > before
