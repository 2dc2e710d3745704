"""``ssrvlad encode``."""

import dataclasses
from pathlib import Path
from typing import Literal

from ...encoding.selection import FrameSelection
from ..options import Json, MaybePreset, StoredChannels, option, switch
from ..output import finish, note, note_first, print_json, progress_bar, say

Engine = Literal["local", "ray"]

_COMPLETE = "whole folders as SOURCE, without --topic, --fps, --every and --start"


def encode(
    *,
    source: FrameSelection,
    output: str = option(
        "Database to create or extend: a folder or a URI.", "--output", "-o", default=...
    ),
    preset: MaybePreset = None,
    channel: StoredChannels = None,
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
    from ...database.database import Database
    from ...encoding.results import EncodeOptions
    from ...files import is_uri
    from ...map import Map

    folders = all(is_uri(path) or Path(path).is_dir() for path in source.paths)
    # all frames of the folders are used, so that one without a file is gone
    complete = folders and not source.changed("topic", "fps", "every", "start", "layout")
    if prune and not complete:
        raise ValueError(f"--prune needs {_COMPLETE}")
    if gpus and engine != "ray":  # before a network is opened, and where nothing is to be encoded
        raise ValueError("--gpus needs --engine ray and --segmenter")
    town = Map.open(output, preset=preset, channels=channel)
    summary = town.up_to_date(source, complete, prune)
    if summary is None:
        frames = town.source(source, note=note)
        with progress_bar("encoding", len(frames.files)) as bar:
            options = EncodeOptions(source.workers, complete, prune, bar.advance, bar.skip, gpus)
            try:
                summary = town.add(frames, options, engine, note)
            except (KeyboardInterrupt, SystemExit):
                note(f"{output} holds {len(town)} frames; the same command goes on from there")
                raise
    if as_json:
        info = Database.open(output).info() if Database.exists(output) else {}
        skipped = {"skipped": [frame._asdict() for frame in summary.skipped]}
        report = dataclasses.asdict(summary) | {"anew": dict(summary.anew)} | skipped
        print_json({"database": output, **report, **info})
    else:
        say(f"{output}: {summary}")
    gone = f"is in {output}, but its file is gone; --prune removes it"
    note_first(summary.gone, lambda frame: note(f"{frame} {gone}"), "gone:")
    finish(summary.skipped, summary.encoded + summary.anew.total() + summary.already_there)
