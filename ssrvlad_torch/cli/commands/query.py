"""``ssrvlad query``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ...encoding.selection import FrameSelection
from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, option
from ..output import encoding_bar, finish, note, print_json, say

if TYPE_CHECKING:
    from ...search.answers import Answers


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

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...map import Map

    settings = {**recognition.settings(), "sequences": from_sequence, "exclude": exclude}
    town = Map.open(database, version=as_of)
    frames = town.source(source, compared=True, note=note)
    with encoding_bar(frames.files, then="recognising") as bar:
        answers = town.query(frames, recognition.steps(), top, **settings, progress=bar.advance)
    _print(answers, threshold, as_json)
    finish(answers.skipped, len(answers))


def _print(answers: Answers, threshold: float | None, as_json: bool) -> None:
    """Prints the candidates of each query whose score is above a threshold, and the steps."""
    from ...search.answers import estimate_in_json
    from ..words import steps_in_words

    least = -math.inf if threshold is None else threshold
    used, t = answers.recognised.used, answers.temporal
    for answer in answers:
        ranked = [candidate for candidate in answer.candidates if candidate.score > least]
        if as_json:
            candidates = [{"frame": frame, "score": score} for frame, score, _ in ranked]
            details = {"confidence": answer.confidence, "temporal": t, "steps": used}
            details["estimate"] = estimate_in_json(answers.estimate)
            named = {"query": answer.query, "candidates": candidates, "score_is": answer.score_is}
            print_json({**named, **details})
        else:
            listed = ", ".join(f"{frame} {score:.4f}" for frame, score, _ in ranked)
            sure = f"{answer.score_is}, confidence {answer.confidence:.2f}"
            say(f"{answer.query}: {listed or 'no candidate'} ({sure})")
    if not as_json:
        is_before = threshold is not None and answers.estimate.accepted
        before = ", before --threshold" if is_before else ""
        note(steps_in_words(used, t, answers.estimate) + before)
