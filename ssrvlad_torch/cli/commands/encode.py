"""``ssrvlad encode``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..options import Extra, Json, MaybePreset, SourceOptions, option
from ..output import finish, note, print_json, progress_bar, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...database.metadata import ExtraDescriptor
    from ...descriptor import SSRVLAD
    from ...encoding.results import Skipped
    from ...encoding.source import Source

Engine = Literal["local", "ray"]


def encode(
    *,
    source: SourceOptions,
    output: str = option(
        "Database to create or extend: a folder or a URI.", "--output", "-o", default=...
    ),
    preset: MaybePreset = None,
    extra: Extra = None,
    engine: Engine = option(
        "local: threads of this machine; ray: Ray Data, on this machine or a cluster.",
        default="local",
    ),
    gpus: float = option("Extra --engine ray: GPUs for each worker.", default=0.0, min=0),
    prune: bool = option(
        "Remove frames whose file is no longer in the folders of SOURCE.", "--prune", default=False
    ),
    as_json: Json = False,
) -> None:
    """Encode label maps, or images with --segmenter, into a database. A later run encodes only
    missing frames, and frames whose file, pose, label space or segmenter has changed.

    Example: ssrvlad encode maps/monday maps/tuesday -o town.ssrdb --labels-as camvid-11

    \b
    Example: ssrvlad encode photos/monday -o both.ssrdb --segmenter seg.yaml \\
    --labels-as cityscapes-trainids
    """
    from ...config import SSRVLADConfig
    from ...database.database import Database
    from ...datasets.names import is_uri
    from ...datasets.videos import played
    from ...descriptor import SSRVLAD
    from ...encoding.encoder import encode_to_database
    from ...encoding.ray_engine import encode_with_ray
    from ...encoding.results import EncodeOptions, Summary
    from ..sources import extra_of, resolve

    folders = all(is_uri(path) or Path(path).is_dir() for path in source.paths)
    complete = folders and source.takes_all and source.layout is None
    if prune and not complete:
        raise ValueError(
            "--prune needs whole folders as SOURCE, without --fps, --every and --start"
        )
    no_gpus = ValueError("--gpus needs --engine ray and --segmenter")
    if gpus and engine != "ray":
        raise no_gpus
    database = Database.open(output) if Database.exists(output) else None
    frames = resolve(source, database)
    if gpus and not frames.segmenter:
        raise no_gpus
    stored = extra_of(frames, extra, database is None)
    if preset is None and database:
        config = dataclasses.replace(database.config, labels_as=frames.labels_as)
    else:
        config = SSRVLADConfig.from_preset(preset or "default", labels_as=frames.labels_as)
    head, skipped = SSRVLAD(config), []
    if database:
        database.require(config, stored)
    else:
        skipped = _skipped_before_the_first(head, frames, stored)
        if len(skipped) < len(frames.files):
            database = Database.open_or_create(output, config, stored)
    summary = Summary(skipped=skipped)
    if database:
        run = encode_with_ray if engine == "ray" else encode_to_database
        with progress_bar("encoding", len(frames.files), played(frames.files)) as bar:
            options = EncodeOptions(source.workers, complete, prune, bar.advance, bar.skip, gpus)
            summary = run(head, frames.files, database, options, frames.segmenter)
    if as_json:
        named = [frame._asdict() for frame in summary.skipped]
        report = {**dataclasses.asdict(summary), "anew": dict(summary.anew), "skipped": named}
        info = Database.open(output).info() if database else {}
        print_json({"database": output, **report, **info})
    else:
        say(f"{output}: {summary}")
    for frame in summary.gone:
        note(f"{frame} is in {output}, but its file is gone; --prune removes it")
    finish(summary.skipped, summary.described)


def _skipped_before_the_first(
    head: SSRVLAD, source: Source, extra: Sequence[ExtraDescriptor]
) -> list[Skipped]:
    """The frames before the first that can be encoded: a run that fails makes no database."""
    from ...encoding.encoder import encode
    from ...encoding.results import Skipped

    skipped = []
    for file in source.files:
        (result,) = encode(head, [file], 1, source.segmenter, extra)
        if not isinstance(result, Skipped):
            break
        skipped.append(result)
    return skipped
