"""``ssrvlad encode``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..options import Extra, Json, MaybePreset, SourceOptions, option, switch
from ..output import finish, note, print_json, progress_bar, say

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ...database.metadata import ExtraDescriptor
    from ...descriptor import SSRVLAD
    from ...encoding.results import EncodeOptions, Summary
    from ...encoding.source import Source

Engine = Literal["local", "ray"]

_MUCH_VOID = 0.5


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
    prune: bool = switch(
        "--prune", "Remove frames whose file is no longer in the folders of SOURCE."
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
    from ...descriptor import SSRVLAD
    from ...encoding.encoder import before_the_first, encode_to_database
    from ...encoding.ray_engine import encode_with_ray
    from ...encoding.results import EncodeOptions, Skipped, Summary
    from ...files import is_uri
    from ..sources import extra_of, resolve

    folders = all(is_uri(path) or Path(path).is_dir() for path in source.paths)
    complete = folders and not source.given("fps", "every", "start", "layout")
    if prune and not complete:
        raise ValueError(
            "--prune needs whole folders as SOURCE, without --fps, --every and --start"
        )
    no_gpus = ValueError("--gpus needs --engine ray and --segmenter")
    if gpus and engine != "ray":
        raise no_gpus
    new = not Database.exists(output)
    database = None if new else Database.open(output)
    frames = resolve(source, database)
    if gpus and not frames.segmenter:
        raise no_gpus
    stored = extra_of(frames, extra, new)
    if preset is None and database:
        config = dataclasses.replace(database.config, labels_as=frames.labels_as)
    else:
        config = SSRVLADConfig.from_preset(preset or "default", labels_as=frames.labels_as)
    head, skipped = SSRVLAD(config), list[Skipped]()
    of_pictures = database and any(origin.segmenter for origin in database.origins.values())
    if not database:
        # a run that fails makes no database
        skipped, void = before_the_first(head, frames.files, frames.segmenter, stored)
        if void > _MUCH_VOID:
            first, name = frames.files[len(skipped)].location, head.label_space.name
            note(f"{first}: {void:.0%} is void in {name}; is --labels-as right?")
    elif frames.segmenter and extra is None and not (database.extra or of_pictures):
        note(f"{output} is of label maps alone: features and HOG are not stored")
    summary = Summary(skipped=skipped)
    if len(skipped) < len(frames.files):
        run = encode_with_ray if engine == "ray" else encode_to_database
        options = EncodeOptions(source.workers, complete, prune, gpus=gpus)
        summary = _run(run, head, frames, output, stored, options, new)
    if as_json:
        named = [frame._asdict() for frame in summary.skipped]
        report = {**dataclasses.asdict(summary), "anew": dict(summary.anew), "skipped": named}
        info = Database.open(output).info() if Database.exists(output) else {}
        print_json({"database": output, **report, **info})
    else:
        say(f"{output}: {summary}")
    for frame in summary.gone:
        note(f"{frame} is in {output}, but its file is gone; --prune removes it")
    described = summary.encoded + summary.anew.total() + summary.already_there
    finish(summary.skipped, described)


def _run(
    run: Callable[..., Summary],
    head: SSRVLAD,
    source: Source,
    output: str,
    extra: Sequence[ExtraDescriptor],
    options: EncodeOptions,
    new: bool,
) -> Summary:
    """Encodes into a database, and notes which other label spaces it holds; if that fails, a new
    one without frames is deleted."""
    from ...database.database import Database
    from ...database.engine import discard_empty
    from ...datasets.videos import played

    with progress_bar("encoding", len(source.files), played(source.files)) as bar:
        options = dataclasses.replace(options, progress=bar.advance, skipped=bar.skip)
        database = Database.open_or_create(output, head.config, extra)
        try:
            summary = run(head, source.files, database, options, source.segmenter)
        except BaseException as error:
            del database
            if new:
                discard_empty(output, error)
            raise
    database, own = Database.open(output), head.label_space
    if len(database.origins) > 1:
        others = [space.name for space in database.label_spaces() if space.digest != own.digest]
        if others:
            names = " and ".join(f"another {own.name}" if n == own.name else n for n in others)
            note(f"{output} also holds frames of {names}")
    return summary
