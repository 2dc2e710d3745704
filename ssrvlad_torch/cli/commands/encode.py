"""``ssrvlad encode``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from ...config import SSRVLADConfig
from ...database.database import Database
from ...datasets.frame_files import FrameFile
from ...datasets.remote_files import find_remote_files, is_uri
from ...descriptor import SSRVLAD
from ...encoding.encoder import Refusal, Summary, encode_to_database
from ...encoding.ray_engine import encode_with_ray
from ...segmentation.segmenter import Segmenter
from .. import options
from ..options import Choosing, Segmenting, Selection
from ..output import finish, note, print_json
from ..sources import Source, with_labels_as
from .db import contents

Engine = Literal["local", "ray"]


def encode(
    source: options.Sources,
    output: Annotated[Path, typer.Option("--output", "-o", help="Database: new, or added to.")],
    labels_as: Annotated[
        str | None,
        typer.Option(
            help="Label space of the ids: a name or a .yaml file; the data set's with --layout."
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="paper or default; if not given the database's, or default."),
    ] = None,
    layout: options.LayoutName = None,
    split: options.Splits = None,
    role: options.RoleName = None,
    labels: options.LabelsFolder = None,
    sequence: options.SequenceName = None,
    every: options.Every = 1,
    start: options.Start = 0,
    segmenter: options.SegmenterFile = None,
    segmenter_cache: options.SegmenterCache = None,
    workers: options.Workers = 2,
    engine: Annotated[
        Engine,
        typer.Option(
            help="local, or ray: Ray Data, on this machine or a cluster it is part of, also from "
            "URIs, as s3://bucket/monday."
        ),
    ] = "local",
    prune: Annotated[
        bool,
        typer.Option(
            "--prune", help="Remove frames whose file is gone from the folders that are given."
        ),
    ] = False,
    as_json: options.Json = False,
) -> None:
    """Encode label maps, or images with a segmenter, into a database. Run again, it adds only
    what is missing or has changed, whatever ended the last run.

    Example: ssrvlad encode maps/monday maps/tuesday -o town.ssrdb --labels-as camvid-11
    """
    choosing = Choosing(layout, split, role, labels)
    selection, segmenting = (
        Selection(sequence, every, start),
        Segmenting(segmenter, segmenter_cache),
    )
    opened = Source.open(source, labels_as, choosing, selection, segmenting, workers)
    summary = _encode(opened, output, preset, engine, prune)
    if as_json:
        counts = dataclasses.asdict(summary)
        refused = [refusal._asdict() for refusal in summary.refused]
        print_json({"database": str(output), **counts, "refused": refused, **contents(output)})
    else:
        print(f"{output}: {_told(summary)}")
    for frame in summary.gone:
        note(f"{frame} is in {output} and its file is gone; --prune removes it")
    finish(summary.refused)


def _encode(
    source: Source, output: Path, preset: str | None, engine: Engine, prune: bool
) -> Summary:
    if source.labels_as is None:
        raise ValueError("Missing option '--labels-as': what the ids of the label maps mean")
    complete = _is_complete(source)
    if prune and not complete:
        raise ValueError("--prune wants whole folders as sources, without --every and --start")
    if preset is None and Database.exists(output):
        config = with_labels_as(Database.open(output).config, source.labels_as)
    else:
        config = SSRVLADConfig.from_preset(preset or "default", labels_as=source.labels_as)
    head = SSRVLAD(config)
    files, segmenter = _frames(source, engine)
    database, workers = Database.open_or_create(output, config), source.workers
    with _progress(len(files)) as (advance, refuse):
        if engine == "ray":
            return encode_with_ray(
                config, files, database, workers, advance, complete, prune, refuse
            )
        return encode_to_database(
            head, files, database, workers, advance, segmenter, complete, prune, refuse
        )


def _frames(source: Source, engine: Engine) -> tuple[list[FrameFile], Segmenter | None]:
    """The frames, and what segments them if they are images; of Ray also those of URIs."""
    assert source.labels_as
    uris = [path for path in source.paths if is_uri(path)]
    if engine == "local" and uris:
        raise ValueError(f"{uris[0]} is no path; a URI wants --engine ray")
    if engine == "local":
        return source.frames(source.labels_as)
    if source.segmenting.network:
        raise ValueError("--engine ray takes no --segmenter")
    taken = source.selection
    remote = find_remote_files(uris, taken.sequence, taken.every, taken.start)
    paths = [path for path in source.paths if not is_uri(path)]
    local = dataclasses.replace(source, paths=paths).label_files() if paths else []
    return [*local, *remote], None


def _is_complete(source: Source) -> bool:
    """Whether the source holds all the frames of its sequences."""
    whole = source.selection.every == 1 and source.selection.start == 0
    return whole and source.dataset is None and all(Path(path).is_dir() for path in source.paths)


def _told(summary: Summary) -> str:
    counts = {
        f"frames encoded ({summary.empty} of them empty)": summary.encoded,
        "changed": summary.changed,
        "already there": summary.already_there,
        "removed": summary.pruned,
        "refused": len(summary.refused),
    }
    rare = ("changed", "removed")
    return ", ".join(f"{n} {what}" for what, n in counts.items() if n or what not in rare)


@contextmanager
def _progress(total: int) -> Iterator[tuple[Callable[[int], None], Callable[[Refusal], None]]]:
    """A progress bar with the rate and the number of refused frames, on a terminal only."""
    columns = (
        TextColumn("encoding"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:.0f}/s, {task.fields[refused]} refused"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, rate=0.0, refused=0)

        def advance(done: int) -> None:
            bar.update(task, advance=done, rate=bar.tasks[task].speed or 0.0)

        def refuse(_refusal: Refusal) -> None:
            bar.update(task, refused=bar.tasks[task].fields["refused"] + 1)

        yield advance, refuse
