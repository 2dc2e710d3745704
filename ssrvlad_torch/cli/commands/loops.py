"""``ssrvlad loops``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ...evaluation.thresholds import SURE_PRECISION, queries_needed
from ...loops.config import LoopConfig
from ..options import Json, MaybePreset, SourceOptions, option
from ..output import figure, finish, fused_in_words, print_json, say

if TYPE_CHECKING:
    from ...database.database import Database
    from ...encoding.results import Encoded, Skipped
    from ...loops.detector import LoopDetector
    from ...loops.result import LoopResult
    from ..sources import Source

STDIN = "-"
FIELDS = ("frame", "reason", "candidate", "score", "probability", "ahead")


def loops(
    *,
    source: SourceOptions,
    exclude: int = option(
        LoopConfig.exclude, "Number of last frames that are no candidates.", min=0
    ),
    threshold: float = option(
        LoopConfig.threshold,
        "Report a loop only if its probability is at least this.",
        min=0,
        max=1,
    ),
    sweep: bool = option(LoopConfig.sweep, "Describe each frame from three anchors."),
    memory: Path | None = option(
        None, "Database that keeps the frames: made, or continued if it exists."
    ),
    picture: Path | None = option(None, "Picture to write: the loops, and the drive by poses.csv."),
    tolerance_metres: float | None = option(
        None, "Measure precision and recall: a loop is right within so many metres."
    ),
    preset: MaybePreset = None,
    beside: Literal["hog"] | None = option(
        None,
        "Describe each image by this method, too: recognition then uses both. With --memory: "
        "only when the database is new. It wants a --segmenter.",
        "--with",
    ),
    as_json: Json = False,
) -> None:
    """Find loop closures in a stream of frames while it comes.

    SOURCE - reads names of files from stdin, one a line, and takes each as soon as it is there.

    Example: ssrvlad loops maps/monday --labels-as camvid-11 --picture loops.png
    """
    from ...database.database import Database
    from ...encoding.results import Skipped
    from ...loops.picture import draw_loops
    from ...loops.stream import detect_loops, loops_of, open_detector, report
    from ...picture import require_picture, write_picture
    from ..sources import Source, only_label_space

    config = LoopConfig(exclude, threshold, sweep)
    given = Source.open(source)
    labels_as = given.labels_as
    if labels_as is None and memory and Database.exists(memory):
        labels_as = only_label_space(Database.open(memory))
    if labels_as is None:
        raise ValueError("Missing option '--labels-as': what the ids of the label maps mean")
    if picture:
        require_picture(picture)
    also = given.described_by(beside)
    detector, database = open_detector(config, memory, preset, labels_as, also)
    results: list[LoopResult] = []
    skipped: list[Skipped] = []
    frames = _frames(given, detector, database)
    with closing(detect_loops(detector, frames, database)) as stream:
        for result in stream:
            if isinstance(result, Skipped):
                skipped.append(result)
            else:
                results.append(result)
                _print_result(result, as_json)
    _print_report(report(detector, results, tolerance_metres), as_json)
    if picture:
        pairs = loops_of(detector, results)
        title, drives = " ".join(source.paths), [f.rpartition("/")[0] for f in detector.frames]
        figure = draw_loops(pairs, detector.poses, title, tolerance_metres, drives)
        write_picture(figure, picture)
    finish(skipped, len(results))


def _frames(
    source: Source, detector: LoopDetector, database: Database | None
) -> Iterator[Encoded | Skipped]:
    """The frames that a detector does not know yet: of folders, or as their names arrive on
    stdin."""
    from ...encoding.plan import check_folders
    from ...loops.stream import encode_as_they_come, encode_files

    labels_as, given = detector.head.config.labels_as, source.given
    if STDIN not in given.paths:
        if database:
            source = replace(source, known=database.folders())
        files, segmenter = source.frames(labels_as)
        if database:
            check_folders(files, database.known())
        return encode_files(detector, files, given.workers, segmenter)
    if len(given.paths) > 1 or not given.takes_all:
        raise ValueError(f"{STDIN}, the names on stdin, stands alone, without --every and --start")
    names = map(os.fsdecode, sys.stdin.buffer)
    segmenter = source.segmenter(labels_as)
    return encode_as_they_come(detector, names, given.sequence, segmenter, database)


def _print_result(result: LoopResult, as_json: bool) -> None:
    if as_json:
        print_json({name: getattr(result, name) for name in FIELDS})
    elif result.accepted:
        ahead = "" if result.ahead is None else f" {result.ahead:+.1f} m"
        say(f"{result.frame}: {result.candidate} {result.probability:.4f}{ahead}")


def _print_report(told: Mapping[str, Any], as_json: bool) -> None:
    """In JSON only if precision and recall were asked for: every other line is a frame."""
    if as_json:
        if "precision" in told:
            print_json(told)
        return
    reasons = (f"{count} {reason}" for reason, count in sorted(told["reasons"].items()))
    say(f"{told['frames']} frames: {', '.join(reasons) or 'nothing'}")
    columns = ", ".join(map(str, told["steps"]["sweep"])) or "0"
    steps = ["standardised", f"anchors {columns}", "no temporal sum", "followed online"]
    say(f"steps: {', '.join([*steps, *fused_in_words([told['steps']['weights']])])}")
    if "precision" not in told:
        return
    say(
        f"precision {figure(told['precision'])} ({told['right']} of {told['accepted']} loops "
        f"are right), recall {figure(told['recall'])} ({told['recognised']} of "
        f"{told['revisits']} revisits)"
    )
    if not told["suggested"]:
        say("no threshold to suggest: no candidate is right; a drive with revisits is needed")
        return
    point = told["suggested"]
    say(
        f"surest threshold {point['score']:.4g}: precision {figure(point['precision'])}, "
        f"by its 95 % interval at least {figure(point['precision_low'])}, recall "
        f"{figure(point['recall'])}; to prove a precision of {SURE_PRECISION:g} takes at least "
        f"{queries_needed()} loops without a mistake"
    )
