"""``ssrvlad encode``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..options import Json, MaybePreset, SourceOptions
from ..output import finish, note, print_json, progress_bar
from .db import contents

if TYPE_CHECKING:
    from ...datasets.frame_files import FrameFile
    from ...encoding.encoder import Summary
    from ...segmentation.segmenter import Segmenter
    from ..sources import Source

Engine = Literal["local", "ray"]


def encode(
    source: SourceOptions,
    output: Annotated[Path, typer.Option("--output", "-o", help="Database: new, or added to.")],
    preset: MaybePreset = None,
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
    as_json: Json = False,
) -> None:
    """Encode label maps, or images with a segmenter, into a database. Run again, it adds only
    what is missing or has changed, whatever ended the last run.

    Example: ssrvlad encode maps/monday maps/tuesday -o town.ssrdb --labels-as camvid-11
    """
    from ..sources import Source

    summary = _encode(Source.open(source), output, preset, engine, prune)
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
    from ...config import SSRVLADConfig
    from ...database.database import Database
    from ...descriptor import SSRVLAD
    from ...encoding.encoder import encode_to_database
    from ...encoding.ray_engine import encode_with_ray
    from ..sources import with_labels_as

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
    database, workers = Database.open_or_create(output, config), source.given.workers
    with progress_bar("encoding", len(files)) as (advance, refuse):
        if engine == "ray":
            return encode_with_ray(
                config, files, database, workers, advance, complete, prune, refuse
            )
        return encode_to_database(
            head, files, database, workers, advance, segmenter, complete, prune, refuse
        )


def _frames(source: Source, engine: Engine) -> tuple[list[FrameFile], Segmenter | None]:
    """The frames, and what segments them if they are images; of Ray also those of URIs."""
    from ...datasets.remote_files import find_remote_files, is_uri

    assert source.labels_as
    given = source.given
    uris = [path for path in given.paths if is_uri(path)]
    if engine == "local" and uris:
        raise ValueError(f"{uris[0]} is no path; a URI wants --engine ray")
    if engine == "local":
        return source.frames(source.labels_as)
    if given.segmenter:
        raise ValueError("--engine ray takes no --segmenter")
    remote = find_remote_files(uris, given.sequence, given.every, given.start)
    paths = [path for path in given.paths if not is_uri(path)]
    here = dataclasses.replace(source, given=dataclasses.replace(given, paths=paths))
    return [*(here.label_files() if paths else []), *remote], None


def _is_complete(source: Source) -> bool:
    """Whether the source holds all the frames of its sequences."""
    paths = source.given.paths
    return (
        source.given.takes_all
        and source.dataset is None
        and all(Path(path).is_dir() for path in paths)
    )


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
