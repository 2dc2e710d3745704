"""``ssrvlad db``."""

from pathlib import Path
from typing import Literal

import typer

from ..options import AsOf, DatabaseFolder, Json, expand, option, switch
from ..output import SOME_SKIPPED, note, print_json, progress_bar, say

db = typer.Typer(
    help="Inspect, verify, compact, index or export a database.", rich_markup_mode=None
)


@db.command()
@expand
def info(database: DatabaseFolder, as_of: AsOf = None, as_json: Json = False) -> None:
    """Print what is in a database.

    Example: ssrvlad db info town.ssrdb
    """
    from ...database.database import Database

    opened = Database.open(database, as_of)
    report = opened.info()
    if as_json:
        print_json(report)
        return
    if report["config"]:
        report["config"] = {name: report["config"][name] for name in opened.config.used()}
    if len(report["channels"]) == 1:
        del report["channels"]
    for name, value in report.items():
        entries = value if isinstance(value, dict) else {}
        text = ", ".join(f"{key} {entry}" for key, entry in entries.items()) or value
        say(f"{name.replace('_', ' ')}: {text}")


@db.command()
@expand
def history(database: DatabaseFolder, as_json: Json = False) -> None:
    """Print the stored versions of a database, oldest first. --as-of of other commands reads them.

    Example: ssrvlad db history town.ssrdb
    """
    from ...database.database import Database

    for entry in Database.open(database).history():
        if as_json:
            print_json({**entry._asdict(), "time": entry.time.isoformat()})
        else:
            when = entry.time.isoformat(" ", "seconds")
            say(f"{entry.version}  {when}  {entry.frames} frames  {entry.change}")


@db.command()
@expand
def compact(
    *,
    database: DatabaseFolder,
    keep_days: float = option(
        "Largest age in days of versions to keep.", default=14, min=0, max=100_000
    ),
) -> None:
    """Join small files, and delete old versions and the files that only they use.

    Example: ssrvlad db compact town.ssrdb --keep-days 0
    """
    from ...database.database import Database

    opened = Database.open(database)
    opened.compact(keep_days)
    say(f"{database}: {len(opened)} frames, {len(opened.history())} versions kept")


@db.command()
@expand
def index(database: DatabaseFolder, as_json: Json = False) -> None:
    """Write an index of all channels on disk. Query, evaluate and Map.locate take it by themselves
    in a large database, and encode keeps it complete.

    Example: ssrvlad db index town.ssrdb
    """
    from ...database.database import Database
    from ...search.index import LEAST_ROWS, build

    opened = Database.open(database)
    report = build(opened)
    if as_json:
        print_json(report._asdict())
        return
    channels = ", ".join(column.name for column in opened.columns)
    say(
        f"{database}: index of {channels}: {report.new} of {report.frames} frames in "
        f"{report.seconds:.1f} s, {report.bytes / 1e6:.0f} MB"
    )
    if report.frames < LEAST_ROWS:
        say(f"a database of fewer than {LEAST_ROWS} frames is searched faster without it")


@db.command()
@expand
def verify(
    *,
    database: DatabaseFolder,
    drop_damaged: bool = switch(
        "--drop-damaged", "Remove damaged frames. ssrvlad encode restores them."
    ),
    as_json: Json = False,
) -> None:
    """Check that every byte of a database and its index is as it was written. The exit code is 3 if
    a byte has changed.

    Example: ssrvlad db verify town.ssrdb
    """
    from ...database.database import Database
    from ...search.index import damaged

    opened = Database.open(database)
    frames, files = len(opened), damaged(opened)
    with progress_bar("verifying", frames) as bar:
        damage = opened.damage(bar.advance)
    if as_json:
        print_json(
            {"frames": frames, "damage": [entry._asdict() for entry in damage], "index": files}
        )
    else:
        say(f"{database}: {frames} frames, {sum(entry.rows for entry in damage)} damaged")
    for entry in damage:
        note(f"{database}/{entry.file}: {entry.rows} frames lost: {entry.reason}")
    for file in files:
        note(
            f"{database}/{file} is damaged, or of another version; ssrvlad db index writes it anew"
        )
    if damage and drop_damaged:
        opened.drop_damaged()
        note(f"{database} now holds the {len(opened)} undamaged frames")
    if damage or files:
        raise typer.Exit(SOME_SKIPPED)


@db.command()
@expand
def export(
    *,
    database: DatabaseFolder,
    output: Path = option("File to write.", "--output", "-o", default=...),
    form: Literal["npy", "hloc"] = option(
        "npy: an array, with the ids of the frames, the fingerprint and the settings in files "
        "beside it; hloc: global descriptors in HDF5.",
        "--format",
        default=...,
    ),
    as_of: AsOf = None,
) -> None:
    """Write the descriptors of a database in another form.

    Example: ssrvlad db export town.ssrdb --format npy -o town.npy
    """
    from ...database.database import Database
    from ...database.exporting import export_database

    for file in export_database(Database.open(database, as_of), form, output):
        say(file)
