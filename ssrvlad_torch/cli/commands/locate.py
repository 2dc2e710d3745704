"""``ssrvlad locate``."""

from ...encoding.selection import FrameSelection
from ..options import AnswerOptions, Json, Verbose, option
from ..output import finish, note, print_json, progress_bar


def locate(
    *,
    source: FrameSelection,
    database: str = option("Database of known places.", "--in", default=...),
    answers: AnswerOptions,
    verbose: Verbose = False,
    as_json: Json = False,
) -> None:
    """Print where pictures were taken, each by itself: the best frame of a database, the confidence
    that it is right, and its pose. Without --segmenter, the network that made the database labels
    the pictures. The pictures of a sequence are found far better together, by ssrvlad query.

    Example: ssrvlad locate photos/today/000002.png --in photos.ssrdb --near 12.5,-3,50
    """
    from ...map import Map
    from ...search.answers import answered
    from ..summaries import place_in_json, print_answer, print_estimate

    town = Map.open(database)
    frames = town.source(source, compared=True, images=True, note=note)
    with progress_bar("encoding", len(frames.files), "recognising") as bar:
        places = town.query(frames, top=1, single=True, progress=bar.advance, **vars(answers))
    for answer, exists in zip(places, answered(places.recognised.sure), strict=True):
        if as_json:
            print_json(place_in_json(answer, places))
        else:
            print_answer(answer, verbose, as_json, exists=bool(exists))
    if not as_json:
        print_estimate(places, verbose)
    finish(places.skipped, len(places))
