"""``ssrvlad locate``."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from ..options import Json, RecognitionOptions, SourceOptions, option
from ..output import finish, note, print_json, say

if TYPE_CHECKING:
    from ...database.database import Database
    from ..sources import Source


def locate(
    *,
    source: SourceOptions,
    database: str = option(..., "Database of known places.", "--in"),
    recognition: RecognitionOptions,
    as_json: Json = False,
) -> None:
    """Print where pictures were taken: the best frame of a database, its score, the confidence,
    and the pose. Without --segmenter, the network that made the database labels the pictures.

    Example: ssrvlad locate photos/today/000002.png --in photos.ssrdb
    """
    from ...database.database import Database
    from ..measure import steps_in_words
    from ..recognise import look_up, sure_enough
    from ..sources import Source

    town = Database.open(database)
    opened = Source.open(source, town.folders())
    if source.segmenter is None:
        opened = _by_its_network(town, opened)
    queries, references, found, t, skipped, _ = look_up(town, opened, recognition, top=1)
    scores, rows = sure_enough(found, recognition.min_confidence)
    columns = scores[:, 0].tolist(), rows[:, 0].tolist(), found.confidence.tolist()
    for picture, score, row, sure in zip(queries.frames, *columns, strict=True):
        place = references.frames[row] if row >= 0 else None
        pose = references.poses[row].tolist() if row >= 0 else [math.nan] * 3
        if as_json:
            told = {"picture": picture, "place": place, "score": score if place else None}
            where = dict(zip(("x", "y", "heading"), pose, strict=True))
            print_json({**told, "confidence": sure, **where})
        elif place is None:
            say(f"{picture}: no place (confidence {sure:.2f})")
        else:
            say(f"{picture}: {place}, score {score:.4f}, confidence {sure:.2f}, {_where(*pose)}")
    if not as_json:
        note(steps_in_words(found.used, t))
    finish(skipped, len(queries))


def _by_its_network(town: Database, source: Source) -> Source:
    """The source with the network that made a database; a changed network is refused."""
    from ...localiser import origin_of, require_network

    origin = origin_of(town)
    given = dataclasses.replace(source.given, segmenter=origin.network)
    source = dataclasses.replace(source, given=given, labels_as=origin.label_space)
    segmenter = source.segmenter(origin.label_space or town.config.labels_as)
    if segmenter:
        require_network(town, segmenter)
    return source


def _where(x: float, y: float, heading: float) -> str:
    if math.isnan(x):
        return "pose unknown"
    turned = "unknown" if math.isnan(heading) else f"{math.degrees(heading):.0f} degrees"
    return f"x {x:.1f} m, y {y:.1f} m, heading {turned}"
