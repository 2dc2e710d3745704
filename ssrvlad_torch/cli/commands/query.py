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
        "alone (a fused score of the same range if several channels judge them), a probability for "
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
        "followed over the candidates of the index. --sweep and channels of pictures are not used.",
    ),
    as_of: AsOf = None,
    as_json: Json = False,
) -> None:
    """Recognise places: print candidate frames with their scores for each query, best first, and
    what the scores are. With --json they are score, and score_is is cosine, fused score or
    probability.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """
    from ...datasets.videos import played
    from ...evaluation.measure import estimate_in_json
    from ...map import Map
    from ..words import steps_in_words

    settings = recognition.settings()
    if index and (settings["temporal"] or recognition.channel):
        raise ValueError("--index does not go with a temporal sum or --channel")
    town = Map.open(database, version=as_of)
    beside = " and ".join(column.name for column in town.database.columns[1:])
    frames = town.source(source.wanted(), compared=True, note=note)
    if index and beside:
        note(f"--index searches descriptors of label maps, without {beside} of {database}")
    with progress_bar("encoding", len(frames.files), played(frames.files)) as bar:
        answers = town.query(
            frames,
            recognition.steps(),
            top,
            sequences=from_sequence,
            exclude=exclude,
            index=index,
            progress=bar.advance,
            **settings,
        )
    least = -math.inf if threshold is None else threshold
    used, t = answers.recognised.used, answers.temporal
    for answer in answers:
        ranked = [each for each in answer.candidates if each.score > least]
        if as_json:
            candidates = [{"frame": each.frame, "score": each.score} for each in ranked]
            details = {"confidence": answer.confidence, "temporal": t, "steps": used}
            details["estimate"] = estimate_in_json(answers.estimate)
            named = {"query": answer.query, "candidates": candidates, "score_is": answer.score_is}
            print_json({**named, **details})
        else:
            listed = ", ".join(f"{each.frame} {each.score:.4f}" for each in ranked)
            sure = f"{answer.score_is}, confidence {answer.confidence:.2f}"
            say(f"{answer.query}: {listed or 'no candidate'} ({sure})")
    if not as_json:
        before = ", before --threshold" if least > -math.inf and answers.estimate.accepted else ""
        way = "candidates of the index, " * index
        note(way + steps_in_words(used, t, answers.estimate) + before)
    finish(answers.skipped, len(answers))
