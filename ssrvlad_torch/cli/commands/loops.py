"""``ssrvlad loops``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...evaluation.loops import EVEN
from ...evaluation.metrics import fraction
from ...evaluation.thresholds import SURE_PRECISION, queries_needed
from ...loops.config import LoopConfig
from ..options import Extra, Json, MaybePreset, SourceOptions, option
from ..output import finish, print_json, say, weights_in_words

if TYPE_CHECKING:
    from ...database.database import Database
    from ...encoding.results import Encoded, Skipped
    from ...encoding.source import Source
    from ...loops.detector import LoopDetector
    from ...loops.result import LoopResult

STDIN = "-"
FIELDS = ("frame", "reason", "candidate", "score", "probability", "ahead")


def loops(
    *,
    source: SourceOptions,
    exclude: int = option(
        "Number of most recent frames that are no candidates.", default=LoopConfig.exclude, min=0
    ),
    threshold: float = option(
        "Smallest probability of a reported loop.", default=LoopConfig.threshold, min=0, max=1
    ),
    sweep: bool = option("Describe each frame from three anchors.", default=LoopConfig.sweep),
    memory: Path | None = option(
        "Database to store the frames in; one that exists is continued. The place, and the weights "
        "of fused methods, are then found anew."
    ),
    picture: Path | None = option("Picture to write: the loops on the trajectory."),
    tolerance_metres: float | None = option(
        "Measure precision and recall: largest distance of a right loop in metres."
    ),
    preset: MaybePreset = None,
    extra: Extra = None,
    as_json: Json = False,
) -> None:
    """Find loop closures in a stream of frames, frame by frame.

    SOURCE - reads file names from stdin, one a line, and processes each as soon as it arrives.

    Example: ssrvlad loops maps/monday --labels-as camvid-11 --picture loops.png
    """
    from ...database.database import Database
    from ...encoding.results import Skipped
    from ...files import require_picture, write_picture
    from ...loops.picture import draw_loops
    from ...loops.stream import candidates_of, detect_loops, loops_of, open_detector, report
    from ..sources import extra_of, resolve

    _check_live(source)
    config = LoopConfig(exclude, threshold, sweep)
    stored = Database.open(memory) if memory and Database.exists(memory) else None
    if picture:
        require_picture(picture)
    opened = resolve(source, stored, listed=STDIN not in source.paths)
    methods = extra_of(opened, extra, stored is None)
    detector, database = open_detector(config, memory, preset, opened.labels_as, methods)
    results: list[LoopResult] = []
    skipped: list[Skipped] = []
    frames = _frames(source, opened, detector, database)
    with closing(detect_loops(detector, frames, database)) as stream:
        for result in stream:
            if isinstance(result, Skipped):
                skipped.append(result)
            else:
                results.append(result)
                _print_result(result, as_json)
    summary = report(detector, results, tolerance_metres)
    if results or skipped or as_json or not len(detector):
        _print_report(summary, results, config, as_json)
    else:
        count = f"{len(opened.files)} " if opened.files else ""  # names on stdin are not counted
        say(f"all {count}frames are in the memory already")
    if picture:
        pairs, candidates = loops_of(detector, results), candidates_of(detector, results)
        drives = [frame.rpartition("/")[0] for frame in detector.frames]
        title = ", ".join(dict.fromkeys(drives))
        figure = draw_loops(pairs, detector.poses, title, tolerance_metres, drives, candidates)
        write_picture(figure, picture)
    finish(skipped, len(results))


def _check_live(options: SourceOptions) -> None:
    """Raises a ValueError for options that names on stdin would leave out."""
    given = (options.layout, options.poses, options.topic)
    alone = len(options.paths) == 1 and options.takes_all
    if STDIN in options.paths and not (alone and options.largest_gap is None and not any(given)):
        raise ValueError(
            f"SOURCE {STDIN} takes no other SOURCE, no --layout, --poses, --largest-gap, --topic, "
            "--fps, --every and --start"
        )


def _frames(
    options: SourceOptions, source: Source, detector: LoopDetector, database: Database | None
) -> Iterator[Encoded | Skipped]:
    """The frames that a detector does not know yet, of folders or from names on stdin."""
    from ...encoding.plan import check_folders
    from ...loops.stream import encode_as_they_come, encode_files

    if STDIN not in options.paths:
        if database:
            check_folders(source.files, database.known())
        return encode_files(detector, source.files, options.workers, source.segmenter)
    names = map(os.fsdecode, sys.stdin.buffer)
    return encode_as_they_come(detector, names, options.sequence, source.segmenter, database)


def _print_result(result: LoopResult, as_json: bool) -> None:
    if as_json:
        print_json({name: getattr(result, name) for name in FIELDS})
    elif result.accepted:
        ahead = "" if result.ahead is None else f" {result.ahead:+.1f} m"
        say(f"{result.frame}: {result.candidate} {result.probability:.4f}{ahead}")


def _print_likeliest(results: Sequence[LoopResult], config: LoopConfig) -> None:
    """Where no frame closes a loop: the likeliest pair, and what could be changed."""
    best = max(results, key=lambda result: result.probability or 0.0)
    if best.probability is None:
        say(f"no loop: no frame comes more than --exclude {config.exclude} frames after another")
        return
    unlikely = "" if best.probability >= EVEN else ", more likely wrong than right"
    say(
        f"no loop: the likeliest is {best.frame}: {best.candidate} with probability "
        f"{best.probability:.4f}{unlikely}, --threshold {config.threshold:g}"
    )
    say(
        "pictures and --with, or frames nearer to each other, may find more; a street driven the "
        "other way is never found"
    )


def _print_report(
    summary: Mapping[str, Any], results: Sequence[LoopResult], config: LoopConfig, as_json: bool
) -> None:
    """Prints the summary; as JSON, where each other line is a frame, only if it has a precision."""
    if as_json:
        if "precision" in summary:
            print_json(summary)
        return
    reasons = (f"{count} {reason}" for reason, count in sorted(summary["reasons"].items()))
    say(f"{summary['frames']} frames: {', '.join(reasons) or 'nothing'}")
    columns = ", ".join(map(str, summary["steps"]["sweep"])) or "0"
    steps = ["standardised", f"anchors {columns}", "no temporal sum", "followed online"]
    say(f"steps: {', '.join([*steps, *weights_in_words([summary['steps']['weights']])])}")
    if results and not any(result.accepted for result in results):
        _print_likeliest(results, config)
    if "precision" not in summary:
        return
    say(
        f"precision {fraction(summary['precision'])} ({summary['right']} of "
        f"{summary['accepted']} loops are right), recall {fraction(summary['recall'])} "
        f"({summary['recognised']} of {summary['revisits']} revisits)"
    )
    if not summary["suggested"]:
        say("no threshold to suggest: no candidate is right; a drive with revisits is needed")
        return
    point = summary["suggested"]
    say(
        f"surest threshold {point['score']:.4g}: precision {fraction(point['precision'])}, "
        f"by its 95 % interval at least {fraction(point['precision_low'])}, recall "
        f"{fraction(point['recall'])}; a proof of precision {SURE_PRECISION:g} needs at least "
        f"{queries_needed()} loops without a mistake"
    )
