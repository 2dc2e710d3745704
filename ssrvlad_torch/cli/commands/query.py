"""``ssrvlad query``."""

from __future__ import annotations

import math

from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, SourceOptions, option
from ..output import finish, note, print_json, say


def query(
    *,
    database: DatabaseFolder,
    source: SourceOptions,
    recognition: RecognitionOptions,
    top: int = option(5, "Candidates of each query.", min=1),
    threshold: float | None = option(None, "Leave out candidates whose score is not above this."),
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
        "Leave out candidates of the query's own sequence that are so many frames away or fewer.",
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
    from ...database.reading import Damage
    from ...database.selection import neighbours, select
    from ...recognition.sweep import COLUMNS
    from ..measure import steps_in_words
    from ..recognise import barred, beside, by_index, judged, steps_of, sure_enough
    from ..sources import Source, encode_queries, load_references

    opened = Source.open(source)
    first, last = _window(window)
    if index and (recognition.reach or window or skip_damaged or recognition.fuse):
        raise ValueError(
            "--index does not go with a temporal sum, --window, --skip-damaged or --fuse"
        )
    town, damage = Database.open(database, as_of), list[Damage]()
    steps = steps_of(recognition)
    also = () if index else beside(town, recognition)
    queries, skipped = encode_queries(
        town, opened, COLUMNS if steps.sweep and not index else (), also
    )
    if index:
        all_found, references = by_index(town, queries, steps, top, from_sequence, exclude)
        t: int | dict[str, int] = 0
    else:
        references, t = load_references(town, recognition.reach, damage if skip_damaged else None)
        for entry in damage:
            note(f"left out {entry.rows} frames of {database}/{entry.file}: {entry.reason}")
        limited = from_sequence or window
        where = select(references, from_sequence, first, last) if limited else None
        near = None if exclude is None else neighbours(queries.frames, references, exclude)
        shut = barred(len(queries.frames), len(references.frames), where, near)
        all_found = judged(queries, references, steps, top, shut)
    least = -math.inf if threshold is None else threshold
    matches = sure_enough(all_found, recognition.min_confidence)
    sure, used = all_found.confidence.tolist(), all_found.used
    found = [
        [
            (references.frames[row], score)
            for row, score in zip(rows, scores, strict=True)
            if row >= 0 and score > least
        ]
        for scores, rows in zip(*(m.tolist() for m in matches), strict=True)
    ]
    for frame, ranked, confidence in zip(queries.frames, found, sure, strict=True):
        candidates = [{"frame": name, "score": score} for name, score in ranked]
        if as_json:
            told = {"confidence": confidence, "temporal": t, "steps": used}
            print_json({"query": frame, "candidates": candidates, **told})
        else:
            listed = ", ".join(f"{name} {score:.4f}" for name, score in ranked)
            say(f"{frame}: {listed or 'no candidate'} (confidence {confidence:.2f})")
    if not as_json:
        way = "candidates of the index, " if index else ""
        note(way + steps_in_words(used, t))
    finish(skipped)


def _window(text: str | None) -> tuple[int | None, int | None]:
    if text is None:
        return None, None
    first, colon, last = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return int(first) if first else None, int(last) if last else None
    except ValueError:
        raise ValueError(f"--window wants FIRST:LAST in whole numbers, got {text!r}") from None
