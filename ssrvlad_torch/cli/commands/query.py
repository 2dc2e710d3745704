"""``ssrvlad query``."""

import math

from ..options import AsOf, DatabaseFolder, Json, RecognitionOptions, SourceOptions, option, switch
from ..output import finish, note, print_json, progress_bar, say


def query(
    *,
    database: DatabaseFolder,
    source: SourceOptions,
    recognition: RecognitionOptions,
    top: int = option("Number of candidates of each query.", default=5, min=1),
    threshold: float | None = option(
        "Leave out candidates whose score is not above this: a cosine for queries that are judged "
        "alone (a fused score of the same range if several methods judge them), a probability for "
        "followed ones: of the first candidate that of the place (a few frames around it), of "
        "others that of one frame. The estimate of wrong answers is of all answers, before that.",
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
    index: bool = switch(
        "--index",
        "Search with the index on disk (ssrvlad db index). Scores are exact. Sequences are "
        "followed over the candidates of the index. --sweep and extra descriptors are not used.",
    ),
    as_of: AsOf = None,
    as_json: Json = False,
) -> None:
    """Recognise places: print candidate frames with their scores for each query, best first, and
    what the scores are. With --json they are score, and score_is is cosine, fused score or
    probability.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...database.database import Database
    from ...datasets.videos import played
    from ...encoding.search import accepted, search, search_by_index
    from ...evaluation.measure import estimate_in_json
    from ..sources import resolve
    from ..words import score_name, steps_in_words

    if index and (recognition.reach or recognition.extra):
        raise ValueError("--index does not go with a temporal sum or --extra")
    opened = Database.open(database, as_of)
    top = min(top, max(1, len(opened)))
    frames = resolve(source, opened, compared=True)
    steps = recognition.steps()
    if index and (unused := " and ".join(each.name for each in opened.extra)):
        note(f"--index searches descriptors of label maps, without {unused} of {database}")

    with progress_bar("encoding", len(frames.files), played(frames.files)) as bar:
        if index:
            found = search_by_index(opened, frames, steps, top, from_sequence, exclude, bar.advance)
        else:
            found = search(
                opened,
                frames,
                steps,
                top,
                recognition.reach,
                recognition.with_extra,
                from_sequence,
                exclude,
                bar.advance,
            )
    least = -math.inf if threshold is None else threshold
    used, t = found.recognised.used, found.temporal
    matches, estimate = accepted(
        found.recognised, recognition.min_confidence, recognition.max_wrong
    )
    columns = *(part.tolist() for part in matches), found.recognised.confidence.tolist()
    names = found.queries.frames, found.queries.sequences
    for frame, sequence, scores, rows, confidence in zip(*names, *columns, strict=True):
        kind = score_name(used, sequence)
        ranked = [
            (found.references.frames[row], score)
            for row, score in zip(rows, scores, strict=True)
            if row >= 0 and score > least
        ]
        if as_json:
            candidates = [{"frame": name, "score": score} for name, score in ranked]
            details = {"confidence": confidence, "temporal": t, "steps": used}
            details["estimate"] = estimate_in_json(estimate)
            print_json({"query": frame, "candidates": candidates, "score_is": kind, **details})
        else:
            listed = ", ".join(f"{name} {score:.4f}" for name, score in ranked)
            say(f"{frame}: {listed or 'no candidate'} ({kind}, confidence {confidence:.2f})")
    if not as_json:
        before = ", before --threshold" if least > -math.inf and estimate.accepted else ""
        way = "candidates of the index, " * index
        note(way + steps_in_words(used, t, estimate) + before)
    finish(found.skipped, len(found.queries))
