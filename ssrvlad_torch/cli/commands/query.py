"""``ssrvlad query``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, SourceOptions, option
from ..output import finish, note, print_json, say

if TYPE_CHECKING:
    from torch import Tensor

    from ..recognise import Found


def query(
    *,
    database: DatabaseFolder,
    source: SourceOptions,
    recognition: RecognitionOptions,
    top: int = option(5, "Candidates of each query.", min=1),
    threshold: float | None = option(
        None,
        "Leave out candidates whose score is not above this. Scores are cosines of single frames. "
        "Of followed queries the first is the probability of that place (a few frames around it), "
        "and each other is the probability of that one frame.",
        max=1,
    ),
    from_sequence: list[str] | None = option(
        None, "Take candidates of this sequence only; repeatable."
    ),
    window: str | None = option(
        None,
        "FIRST:LAST, FIRST: or :LAST. Take candidates in this range of numbers or time "
        "stamps only. A frame's number is the last one in its name.",
    ),
    exclude: int | None = option(
        None,
        "Leave out candidates of the query's own sequence that are so many frames away or "
        "fewer. It is that of the query's folder, if the database has it, or --sequence.",
        min=0,
    ),
    index: bool = option(
        False,
        "Search by the index on disk (ssrvlad db index). Scores are exact. Sequences are "
        "followed over the candidates of the index; --sweep has no effect, and descriptors of "
        "pictures are not used.",
        "--index",
    ),
    as_of: AsOf = None,
    skip_damaged: bool = option(
        False, "Leave out damaged frames of the database.", "--skip-damaged"
    ),
    as_json: Json = False,
) -> None:
    """Recognise places: ranked candidate frames with scores for every label map or image.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...database.database import Database
    from ...database.frames import FrameSet
    from ...database.reading import Damage
    from ...database.selection import neighbours, select
    from ..recognise import barred, look_up, look_up_by_index
    from ..sources import Source

    first, last = _window(window)
    if index and (recognition.reach or window or skip_damaged or recognition.fuse):
        raise ValueError(
            "--index does not go with a temporal sum, --window, --skip-damaged or --fuse"
        )
    town = Database.open(database, as_of)
    opened = Source.open(source, town.folders(skip_damaged))
    if index:
        found = look_up_by_index(town, opened, recognition, top, from_sequence, exclude)
    else:

        def shut(queries: FrameSet, references: FrameSet) -> Tensor | None:
            limited = from_sequence or window
            where = select(references, from_sequence, first, last) if limited else None
            near = None if exclude is None else neighbours(queries.frames, references, exclude)
            return barred(len(queries.frames), len(references.frames), where, near)

        damage = list[Damage]() if skip_damaged else None
        found = look_up(town, opened, recognition, top, damage=damage, shut=shut)
        for entry in damage or ():
            note(f"left out {entry.rows} frames of {database}/{entry.file}: {entry.reason}")
    least = -math.inf if threshold is None else threshold
    _print(found, recognition.min_confidence, least, "candidates of the index, " * index, as_json)
    finish(found.skipped, len(found.queries))


def _print(found: Found, min_confidence: float, least: float, way: str, as_json: bool) -> None:
    """A line for each query: its candidates that score more than the least, if it is sure."""
    from ..measure import steps_in_words
    from ..recognise import sure_enough

    used, t = found.recognised.used, found.temporal
    matches = sure_enough(found.recognised, min_confidence)
    columns = *(part.tolist() for part in matches), found.recognised.confidence.tolist()
    for frame, scores, rows, confidence in zip(found.queries.frames, *columns, strict=True):
        ranked = [
            (found.references.frames[row], score)
            for row, score in zip(rows, scores, strict=True)
            if row >= 0 and score > least
        ]
        if as_json:
            candidates = [{"frame": name, "score": score} for name, score in ranked]
            told = {"confidence": confidence, "temporal": t, "steps": used}
            print_json({"query": frame, "candidates": candidates, **told})
        else:
            listed = ", ".join(f"{name} {score:.4f}" for name, score in ranked)
            say(f"{frame}: {listed or 'no candidate'} (confidence {confidence:.2f})")
    if not as_json:
        scores = "; scores: first the probability of the place, then those of single frames"
        followed = any(mode != "no" for mode in used["follow"].values())
        note(way + steps_in_words(used, t) + scores * followed)


def _window(text: str | None) -> tuple[int | None, int | None]:
    if text is None:
        return None, None
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        low, high = int(first) if first else None, int(last) if last else None
    except ValueError:
        raise ValueError(f"--window wants FIRST:LAST in whole numbers, got {text!r}") from None
    if low is not None and high is not None and low > high:
        raise ValueError(f"--window wants a FIRST that is not above LAST, got {text!r}")
    return low, high
