"""``ssrvlad locate``."""

import math

from ...encoding.selection import FrameSelection
from ..options import Json, RecognitionOptions, option
from ..output import finish, note, print_json, progress_bar, say


def locate(
    *,
    source: FrameSelection,
    database: str = option("Database of known places.", "--in", default=...),
    recognition: RecognitionOptions,
    as_json: Json = False,
) -> None:
    """Print where pictures were taken: the best frame of a database, its cosine, fused score or
    probability (score and score_is with --json), confidence and pose. Without --segmenter, the
    network that made the database labels the pictures.

    Example: ssrvlad locate photos/today/000002.png --in photos.ssrdb --near 12.5,-3,50
    """
    from ...datasets.poses import UNKNOWN
    from ...map import Map
    from ...search.answers import estimate_in_json
    from ..summaries import steps_in_words

    town = Map.open(database)
    frames = town.source(source, compared=True, images=True, note=note)
    with progress_bar("encoding", len(frames.files), "recognising") as bar:
        settings = recognition.settings()
        answers = town.query(frames, recognition.steps(), 1, progress=bar.advance, **settings)
    for answer in answers:
        place = answer.candidates[0] if answer.candidates else None
        pose = place.pose if place else UNKNOWN
        if as_json:
            print_json(
                {
                    "picture": answer.query,
                    "place": place and place.frame,
                    "score": place and place.score,
                    "score_is": answer.score_is,
                    "confidence": answer.confidence,
                    "estimate": estimate_in_json(answers.estimate),
                    **pose._asdict(),
                }
            )
        elif place is None:
            say(f"{answer.query}: no place (confidence {answer.confidence:.2f})")
        else:
            sure = f"{answer.score_is} {place.score:.4f}, confidence {answer.confidence:.2f}"
            say(f"{answer.query}: {place.frame}, {sure}, {_where(*pose)}")
    if not as_json:
        note(steps_in_words(answers.recognised.used, answers.temporal, answers.estimate))
    finish(answers.skipped, len(answers))


def _where(x: float, y: float, heading: float) -> str:
    if math.isnan(x):
        return "pose unknown"
    degrees = "unknown" if math.isnan(heading) else f"{math.degrees(heading):.0f} degrees"
    return f"x {x:.1f} m, y {y:.1f} m, heading {degrees}"
