"""``ssrvlad loops``."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...encoding.selection import STDIN, FrameSelection
from ...evaluation.loops import EVEN
from ...evaluation.metrics import fraction
from ...loops.config import LoopConfig
from ..options import Json, MaybePreset, StoredChannels, option
from ..output import finish, note, note_skipped, print_json, say, weights_in_words

if TYPE_CHECKING:
    from ...encoding.results import Skipped
    from ...loops.result import LoopResult

_MEMORY = "Folder or URI to store the frames in; a database that exists is continued where it was."


def loops(
    *,
    source: FrameSelection,
    exclude: int = option(
        "Number of last frames of the sequence that are no candidates.",
        default=LoopConfig.exclude,
        min=0,
    ),
    threshold: float = option(
        "Smallest confidence of a reported loop: the probability that it is right.",
        default=LoopConfig.threshold,
        min=0,
        max=1,
    ),
    sweep: bool = option("Describe each frame from three anchors.", default=LoopConfig.sweep),
    memory: str | None = option(_MEMORY),
    picture: Path | None = option("Picture to write: the loops on the trajectory."),
    tolerance_metres: float | None = option(
        "Measure precision and recall: largest distance of a right loop in metres."
    ),
    preset: MaybePreset = None,
    channel: StoredChannels = None,
    as_json: Json = False,
) -> None:
    """Find loop closures in a stream of frames, frame by frame.

    SOURCE - reads file names from stdin, one a line, and processes each as soon as it arrives.

    Example: ssrvlad loops maps/monday --labels-as camvid-11 --picture loops.png
    """
    from ...database.database import Database
    from ...datasets.names import sequence_of
    from ...encoding.encoder import encode
    from ...encoding.named import encode_names
    from ...encoding.plan import check_folders
    from ...encoding.source import open_frames
    from ...files import require_picture, write_picture
    from ...loops import stream
    from ...loops.picture import draw_loops

    live = STDIN in source.paths
    config = LoopConfig(exclude, threshold, sweep)
    stored = Database.open(memory) if memory and Database.exists(memory) else None
    if picture:
        require_picture(picture)
    opened = open_frames(source, stored, live=live, note=note)
    settings, network = (config, memory, preset, opened.labels_as), opened.segmenter
    detector, database = stream.open_detector(*settings, network, channel, note)
    describer, before = stream.describer_of(detector, network), frozenset(detector.frames)
    if live:
        names = map(os.fsdecode, sys.stdin.buffer)
        frames = encode_names(describer, names, source.sequence, network, database, before)
    else:
        if database:
            check_folders(opened.files, database.known())
        files = [file for file in opened.files if file.frame not in before]
        frames = encode(describer, files, source.workers, network)
    results, skipped = _printed(stream.detect_loops(detector, frames, database), as_json, live)
    if results or skipped or as_json or not len(detector):
        summary = stream.report(detector, results, tolerance_metres)
        _print_report(summary, results, config, as_json)
    else:
        count = f"{len(opened.files)} frames" if opened.files else "frames"  # none of stdin
        say(f"all {count} are in the memory already")
    if picture:
        pairs = stream.loops_of(detector, results)
        candidates = stream.rows_of_candidates(detector, results)
        sequences = [sequence_of(frame) for frame in detector.frames]
        title = ", ".join(dict.fromkeys(sequences))
        drawn = draw_loops(pairs, detector.poses, title, tolerance_metres, sequences, candidates)
        write_picture(drawn, picture)
    finish(skipped, len(detector), are_named=live)


def _printed(
    outcomes: Generator[LoopResult | Skipped], as_json: bool, live: bool
) -> tuple[list[LoopResult], list[Skipped]]:
    """The results and the skipped frames of a stream; each result is printed as it comes, and if
    they come ``live``, each skipped frame."""
    from ...encoding.results import Skipped

    results: list[LoopResult] = []
    skipped: list[Skipped] = []
    with closing(outcomes):
        for result in outcomes:
            if isinstance(result, Skipped):
                skipped.append(result)
                if live:
                    note_skipped(result)
                continue
            results.append(result)
            if as_json:
                print_json(result.as_json())
            elif result.accepted:
                ahead = "" if result.ahead is None else f", {result.ahead:+.1f} m ahead"
                sure = f"confidence {result.confidence:.2f}{ahead}"
                say(f"{result.frame}: {result.candidate} ({sure})")
    return results, skipped


def _print_likeliest(results: Sequence[LoopResult], config: LoopConfig) -> None:
    """Where no frame closes a loop: the likeliest pair, and what could be changed."""
    best = max(results, key=lambda result: result.confidence or 0.0)
    if best.confidence is None:
        say(
            f"no loop: no frame comes more than --exclude {config.exclude} frames after another "
            "of its sequence"
        )
        return
    unlikely = "" if best.confidence >= EVEN else ", more likely wrong than right"
    say(
        f"no loop: the likeliest is {best.frame}: {best.candidate} with confidence "
        f"{best.confidence:.2f}{unlikely}, --threshold {config.threshold:g}"
    )
    recent = sum(result.reason.value == "too_recent" for result in results)
    if 2 * recent > len(results):
        say(
            f"{recent} of {len(results)} frames are too_recent: the --exclude {config.exclude} "
            "frames before each are no candidates; a smaller --exclude may find more"
        )
        return
    say(
        "pictures, or frames nearer to each other, may find more; a street driven the "
        "other way is never found"
    )


def _print_report(
    summary: Mapping[str, Any], results: Sequence[LoopResult], config: LoopConfig, as_json: bool
) -> None:
    """Prints the summary; as JSON, where each other line is a frame, only if it has a precision."""
    from ..summaries import threshold_in_words

    if as_json:
        if "precision" in summary:
            print_json(summary)
        return
    reasons = (f"{count} {reason}" for reason, count in sorted(summary["reasons"].items()))
    say(f"{summary['frames']} frames: {', '.join(reasons) or 'nothing'}")
    columns = ", ".join(map(str, summary["steps"]["sweep"])) or "0"
    steps = ["standardised", f"anchors {columns}", "no temporal sum", "followed online"]
    steps += ["all frames by a part of their signs"] * summary["steps"]["scan"]
    say(f"steps: {', '.join([*steps, *weights_in_words([summary['steps']['weights']])])}")
    if results and not any(result.accepted for result in results):
        _print_likeliest(results, config)
    if "precision" not in summary:
        return
    say(
        f"precision {fraction(summary['precision'])} ({summary['right']} of "
        f"{summary['accepted']} loops are right), recall {fraction(summary['recall'])} "
        f"({summary['right']} of {summary['revisits']} revisits)"
    )
    if not summary["suggested"]:
        say("no threshold to suggest: no candidate is right; a sequence with revisits is needed")
        return
    count = sum(result.confidence is not None for result in results)
    say(f"Suggested threshold {threshold_in_words(summary['suggested'], count)}")
