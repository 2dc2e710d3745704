"""``ssrvlad db``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ..options import DatabaseFolder, Json
from ..output import SOME_REFUSED, note, print_json, progress_bar

db = typer.Typer(help="Look into a database, verify it, export it.", rich_markup_mode=None)


@db.callback(invoke_without_command=False)
def _look() -> None:
    """Look into a database, verify it, export it."""


@db.command()
def info(database: DatabaseFolder, as_json: Json = False) -> None:
    """What is in a database.

    Example: ssrvlad db info town.ssrdb
    """
    report = contents(database)
    if as_json:
        print_json(report)
        return
    for name, value in report.items():
        entries = value.items() if isinstance(value, dict) else ()
        text = ", ".join(f"{key} {entry}" for key, entry in entries) if entries else value
        print(f"{name.replace('_', ' ')}: {text}")


@db.command()
def verify(
    database: DatabaseFolder,
    drop_damaged: Annotated[
        bool,
        typer.Option(
            "--drop-damaged",
            help="Give up the row groups that are not whole; encoding again brings them back.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Read every byte of a database and say what is not as it was written. Exit code 3 if any.

    Example: ssrvlad db verify town.ssrdb
    """
    from ...database.database import Database
    from ...database.storage.verification import verify as find_damage

    opened = Database.open(database, skip_damaged=True)
    with progress_bar("verifying", len(opened)) as bar:
        damage = find_damage(database, bar.advance)
    if as_json:
        print_json({"frames": len(opened), "damage": [entry._asdict() for entry in damage]})
    else:
        print(f"{database}: {len(opened)} frames, {len(damage) or 'no'} damage")
    for entry in damage:
        note(f"{database / entry.file}{entry.place}: {entry.reason}")
    if damage and drop_damaged:
        opened.drop_damaged()
        note(f"{database} now holds the {len(opened)} frames that are whole")
    if damage:
        raise typer.Exit(SOME_REFUSED)


@db.command()
def export(
    database: DatabaseFolder,
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.")],
    form: Annotated[
        Literal["npy", "faiss", "hloc"],
        typer.Option(
            "--format",
            help="npy: an array, and the frames' ids in a text file; faiss: an exact index of "
            "faiss, and the same text file; hloc: global descriptors in HDF5.",
        ),
    ],
) -> None:
    """Write the descriptors of a database in another form.

    Example: ssrvlad db export town.ssrdb --format npy -o town.npy
    """
    from ...database.database import Database
    from ...database.exporting import export_database

    for file in export_database(Database.open(database), form, output):
        print(file)


def contents(path: Path) -> dict[str, Any]:
    """What is in a database, in numbers and words."""
    import numpy as np

    from ...database.database import Database
    from ...database.storage.parts import matrix

    database = Database.open(path)
    frames, length, empty, spaces = database.frames(), database.config.length, 0, Counter[str]()
    for table in database.tables(["labels_as", "descriptor"]):
        empty += int((~matrix(table["descriptor"], length).any(axis=1)).sum())
        spaces.update(table["labels_as"].to_pylist())
    return {
        "frames": len(frames.frames),
        "sequences": dict(Counter(frames.sequences)),
        "empty": empty,
        "with_pose": int((~np.isnan(frames.poses[:, 0])).sum()),
        "label_spaces": dict(spaces),
        "preset": database.config.preset,
        "fingerprint": database.fingerprint,
        "config": database.config.to_dict(),
    }
