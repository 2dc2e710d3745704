"""``ssrvlad locate``."""

import math

from ..options import Json, RecognitionOptions, SourceOptions, option
from ..output import finish, note, print_json, progress_bar, say


def locate(
    *,
    source: SourceOptions,
    database: str = option("Database of known places.", "--in", default=...),
    recognition: RecognitionOptions,
    as_json: Json = False,
) -> None:
    """Print where pictures were taken: the best frame of a database, its cosine, fused score or
    probability (score and score_is with --json), confidence and pose. Without --segmenter, the
    network that made the database labels the pictures.

    Example: ssrvlad locate photos/today/000002.png --in photos.ssrdb
    """
    from ...database.database import Database
    from ...datasets.videos import played
    from ...encoding.search import accepted, search
    from ...evaluation.measure import estimate_in_json
    from ..sources import resolve
    from ..words import score_name, steps_in_words

    opened = Database.open(database)
    frames = resolve(source, opened, compared=True, images=True)
    with progress_bar("encoding", len(frames.files), played(frames.files)) as bar:
        steps, reach, extra = recognition.steps(), recognition.reach, recognition.with_extra
        searched = search(opened, frames, steps, 1, reach, extra, progress=bar.advance)
    queries, references, found, t, skipped, _ = searched
    (scores, rows), estimate = accepted(found, recognition.min_confidence, recognition.max_wrong)
    columns = scores[:, 0].tolist(), rows[:, 0].tolist(), found.confidence.tolist()
    names = queries.frames, queries.sequences
    for picture, sequence, score, row, confidence in zip(*names, *columns, strict=True):
        kind = score_name(found.used, sequence)
        place = references.frames[row] if row >= 0 else None
        pose = references.poses[row].tolist() if row >= 0 else [math.nan] * 3
        if as_json:
            where = dict(zip(("x", "y", "heading"), pose, strict=True))
            match = {"picture": picture, "place": place, "score": score if place else None}
            match |= {"score_is": kind, "confidence": confidence}
            print_json({**match, "estimate": estimate_in_json(estimate), **where})
        elif place is None:
            say(f"{picture}: no place (confidence {confidence:.2f})")
        else:
            sure = f"{kind} {score:.4f}, confidence {confidence:.2f}"
            say(f"{picture}: {place}, {sure}, {_where(*pose)}")
    if not as_json:
        note(steps_in_words(found.used, t, estimate))
    finish(skipped, len(queries))


def _where(x: float, y: float, heading: float) -> str:
    if math.isnan(x):
        return "pose unknown"
    degrees = "unknown" if math.isnan(heading) else f"{math.degrees(heading):.0f} degrees"
    return f"x {x:.1f} m, y {y:.1f} m, heading {degrees}"
