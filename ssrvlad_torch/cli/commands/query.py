"""``ssrvlad query``."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ...encoding.selection import STDIN, FrameSelection
from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, option
from ..output import finish, note, print_json, progress_bar, say

if TYPE_CHECKING:
    from ...map import Map
    from ...search.answers import Answer, Answers


def query(
    *,
    database: DatabaseFolder,
    source: FrameSelection,
    recognition: RecognitionOptions,
    top: int = option("Number of candidates of each query.", default=5, min=1),
    threshold: float | None = option(
        "Leave out candidates whose score is not above this. For queries that are judged alone it "
        "is a cosine, or of several channels a fused score in the same range. For followed ones it "
        "is a probability: of the first candidate that of its place, of others that of one frame. "
        "The estimate of wrong answers is of all answers, before that.",
        max=1,
    ),
    from_sequence: list[str] | None = option(
        "Use only candidates of this sequence; can be repeated."
    ),
    exclude: int | None = option(
        "Leave out candidates of the query's own sequence that are at most N frames away. Its own "
        "sequence is --sequence, or the one that the database has for its folder.",
        min=0,
    ),
    as_of: AsOf = None,
    as_json: Json = False,
) -> None:
    """Recognise places: print candidate frames with their scores for each query, best first, and
    what the scores are. With --json they are score, and score_is is cosine, fused score or
    probability.

    SOURCE - reads file names from stdin, one a line, and with --follow online prints the answer to
    each as soon as it is known.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...map import Map

    if source.is_live:
        for name, value in (("--from-sequence", from_sequence), ("--exclude", exclude)):
            if value is not None:
                raise ValueError(f"SOURCE {STDIN} takes no {name}")
        _track(Map.open(database, version=as_of), source, recognition, top, threshold, as_json)
        return
    settings = {**recognition.settings(), "sequences": from_sequence, "exclude": exclude}
    town = Map.open(database, version=as_of)
    frames = town.source(source, compared=True, note=note)
    with progress_bar("encoding", len(frames.files), "recognising") as bar:
        answers = town.query(frames, recognition.steps(), top, **settings, progress=bar.advance)
    _print(answers, threshold, as_json)
    finish(answers.skipped, len(answers))


def _print(answers: Answers, threshold: float | None, as_json: bool) -> None:
    """Prints the candidates of each query whose score is above a threshold, and the steps."""
    from ...search.answers import estimate_in_json
    from ..summaries import steps_in_words

    used, t = answers.recognised.used, answers.temporal
    for answer in answers:
        details = {"temporal": t, "steps": used, "estimate": estimate_in_json(answers.estimate)}
        _print_answer(answer, threshold, details if as_json else None)
    if not as_json:
        is_before = threshold is not None and answers.estimate.accepted
        before = ", before --threshold" if is_before else ""
        note(steps_in_words(used, t, answers.estimate) + before)


def _print_answer(
    answer: Answer, threshold: float | None, details: Mapping[str, Any] | None
) -> None:
    """Prints the candidates whose score is above a threshold; with details as JSON."""
    least = -math.inf if threshold is None else threshold
    ranked = [candidate for candidate in answer.candidates if candidate.score > least]
    if details is not None:
        print_json({**answer._replace(candidates=ranked).as_json(), **details})
        return
    listed = ", ".join(f"{frame} {score:.4f}" for frame, score, _ in ranked)
    sure = f"{answer.score_is}, confidence {answer.confidence:.2f}"
    say(f"{answer.query}: {listed or 'no candidate'} ({sure})")


def _track(
    town: Map,
    source: FrameSelection,
    recognition: RecognitionOptions,
    top: int,
    threshold: float | None,
    as_json: bool,
) -> None:
    """Prints the answers to frames whose names arrive on stdin."""
    from ...encoding.results import Skipped

    if recognition.follow != "online":
        raise ValueError(
            f"SOURCE {STDIN} answers as frames come: expected --follow online, got "
            f"{recognition.follow}"
        )
    for name, value in (
        ("--temporal", recognition.temporal),
        ("--max-wrong", recognition.max_wrong),
    ):
        if value is not None:
            raise ValueError(f"SOURCE {STDIN} takes no {name}")
    names = map(os.fsdecode, sys.stdin.buffer)
    settings = recognition.steps(), top, recognition.near, recognition.channel
    answered, skipped = 0, []
    for answer in town.track(source, names, *settings, note=note):
        if isinstance(answer, Skipped):
            skipped.append(answer)
            continue
        answered += 1
        sure = answer.confidence >= recognition.min_confidence
        shown = answer if sure else answer._replace(candidates=[])
        _print_answer(shown, threshold, {} if as_json else None)
    finish(skipped, answered)
