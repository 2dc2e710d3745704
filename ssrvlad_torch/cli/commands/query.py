"""``ssrvlad query``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ...encoding.selection import STDIN, FrameSelection
from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, Verbose, option
from ..output import finish, note, note_skipped, progress_bar

if TYPE_CHECKING:
    from ...map import Map


def query(
    *,
    database: DatabaseFolder,
    source: FrameSelection,
    recognition: RecognitionOptions,
    top: int = option("Number of candidates of each query.", default=5, min=1),
    from_sequence: list[str] | None = option(
        "Use only candidates of this sequence; can be repeated.", hidden=True
    ),
    exclude: int | None = option(
        "Leave out candidates of the query's own sequence that are at most N frames away. Its own "
        "sequence is --sequence, or the one that the database has for its folder.",
        min=0,
        hidden=True,
    ),
    as_of: AsOf = None,
    picture: Path | None = option(
        "Picture to write: where the queries are in the map, and some of them beside their answers."
    ),
    verbose: Verbose = False,
    as_json: Json = False,
) -> None:
    """Recognise places: print for each query candidate frames, best first, the confidence that the
    first one is right, and its pose. SOURCE is best a whole sequence. With --json also scores, and
    score_is says what they are: cosine, fused score or probability.

    SOURCE - reads file names from stdin, one a line, and with --follow online prints the answer to
    each as soon as it is known.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...files import require_picture, write_picture
    from ...map import Map
    from ...search.answers import answered
    from ..summaries import print_answer, print_estimate

    if picture:
        require_picture(picture)
    if STDIN in source.paths:
        refused: dict[str, object] = {"--from-sequence": from_sequence, "--exclude": exclude}
        refused |= {"--picture": picture, "--temporal": recognition.temporal}
        refused |= {"--max-wrong": recognition.max_wrong}
        for name, value in refused.items():
            if value is not None:
                raise ValueError(f"SOURCE {STDIN} takes no {name}")
        if recognition.follow != "online":
            raise ValueError(
                f"SOURCE {STDIN} answers as frames come: expected --follow online, got "
                f"{recognition.follow}"
            )
        _track(Map.open(database, version=as_of), source, recognition, top, verbose, as_json)
        return
    town = Map.open(database, version=as_of)
    frames = town.source(source, compared=True, note=note)
    with progress_bar("encoding", len(frames.files), "recognising") as bar:
        settings = {**recognition.settings(), "sequences": from_sequence, "exclude": exclude}
        answers = town.query(frames, top=top, progress=bar.advance, **settings)
    for answer, exists in zip(answers, answered(answers.recognised.sure), strict=True):
        print_answer(answer, verbose, as_json, answers, bool(exists))
    if picture:
        write_picture(town.draw(answers, frames), picture)
    if not as_json:
        print_estimate(answers, verbose)
    finish(answers.skipped, len(answers))


def _track(
    town: Map,
    source: FrameSelection,
    recognition: RecognitionOptions,
    top: int,
    verbose: bool,
    as_json: bool,
) -> None:
    """Prints the answers to frames whose names arrive on stdin."""
    from ...encoding.results import Skipped
    from ..summaries import print_answer

    names = map(os.fsdecode, sys.stdin.buffer)
    settings = recognition.steps(), top, recognition.near, recognition.channels
    count, skipped = 0, []
    for answer in town.track(source, names, *settings, note=note):
        if isinstance(answer, Skipped):
            skipped.append(answer)
            note_skipped(answer)
            continue
        count += 1
        sure, exists = answer.confidence >= recognition.min_confidence, bool(answer.candidates)
        shown = answer if sure else answer._replace(candidates=[])
        print_answer(shown, verbose, as_json, exists=exists)
    if not count and not skipped:
        note("no name came on standard input")
    finish(skipped, count, are_named=True)
