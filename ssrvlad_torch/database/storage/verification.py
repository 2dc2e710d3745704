"""Whether every byte of a database is as it was written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .manifest import MANIFEST, read_manifest
from .parts import Damage, read_intact


def verify(path: str | Path, progress: Callable[[int], None] | None = None) -> list[Damage]:
    """Everything in a database that is not as it was written, found by reading all of it.

    A manifest that is damaged but makes sense is followed to the parts.

    Args:
        path: the database's folder.
        progress: called with the number of frames done since the last call.

    Raises:
        ValueError: the folder is no database, or one of another version.
    """
    folder, damage = Path(path), list[Damage]()
    try:
        manifest = read_manifest(folder)
    except ValueError as error:
        if not (folder / MANIFEST).is_file():
            raise
        damage.append(Damage(MANIFEST, None, str(error).removeprefix(f"{folder / MANIFEST} ")))
        try:
            manifest = read_manifest(folder, damaged=True)
        except ValueError:
            return damage
    for part in manifest.parts:
        damage += read_intact(folder, part, manifest.config.length)[1]
        if progress:
            progress(part.rows)
    return damage
