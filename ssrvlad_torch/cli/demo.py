"""The method on generated data: two drives through a synthetic city, and a picture of matches."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from ..datasets.label_files import LabelMap, find_label_files, read_label_map
from ..datasets.synthetic_city import write_city
from ..encoding.results import EncodeOptions
from ..files import empty_folder, replacing
from ..map import Map
from ..recognition.recognise import Steps
from ..taxonomy import LabelSpace, colourise, label_space

LABELS_AS = "cityscapes-trainids"
PICTURED = 4
STEPS = 4
"""Steps of work for each frame: two to render, one to encode, one to query."""

_HEIGHT, _FRAME, _TEXT = 240, 5, 18
_QUERY, _RIGHT, _WRONG = (90, 98, 110), (26, 127, 55), (207, 34, 46)


class Pair(NamedTuple):
    """A query and its best match, ``(H, W)`` label ids, their titles, and whether it is right."""

    query: LabelMap
    match: LabelMap
    query_name: str
    match_name: str
    right: bool


def run_demo(
    out: Path, frames: int, seed: int, progress: Callable[[int], None]
) -> tuple[dict[str, Any], Path]:
    """Renders a city, encodes the first drive, recognises single frames of the second one, draws
    the result: ``city/``, ``city.ssrdb`` and ``demo.png`` in a new or empty folder. ``progress`` is
    called with the number of further steps that are done, `STEPS` for each frame. Returns the
    metrics of `Map.evaluate`, and the picture."""
    city = empty_folder(out) / "city"
    write_city(city, frames=frames, seed=seed, progress=progress)
    town = Map.open(out / "city.ssrdb", labels_as=LABELS_AS)
    town.add(city / "reference", EncodeOptions(progress=progress))
    alone = Steps(standardise=False, sweep=False, follow=None)
    truth = city / "ground_truth.json"
    evaluation = town.evaluate(city / "query", alone, ground_truth=truth, progress=progress)

    scores, rows = evaluation.recognition.matches
    best, space = rows[:, 0].tolist(), label_space(LABELS_AS)
    right = evaluation.outcomes.correct.tolist()
    queries, references = (find_label_files([str(city / role)]) for role in ("query", "reference"))
    pairs = [
        Pair(
            read_label_map(queries[n], space),
            read_label_map(references[best[n]], space),
            queries[n].frame,
            f"{references[best[n]].frame}, cosine {scores[n, 0]:.2f}",
            right[n],
        )
        for n in chosen(right, [row >= 0 for row in best], PICTURED)
    ]
    picture = out / "demo.png"
    with replacing(picture) as temporary:
        draw_pairs(pairs, space).save(temporary, format="PNG")
    return evaluation.metrics | {"steps": None}, picture


def chosen(right: Sequence[bool], matched: Sequence[bool], count: int) -> list[int]:
    """``count`` queries, evenly spread over those with a best match. If all of them are right and
    another query is wrong, the last wrong query replaces the last one."""
    queries = np.flatnonzero(matched)
    even = np.linspace(0, len(queries) - 1, min(count, len(queries))).astype(int)
    drawn: list[int] = queries[even].tolist()
    wrong = [query for query in queries.tolist() if not right[query]]
    if wrong and all(right[query] for query in drawn):
        drawn[-1] = wrong[-1]
    return drawn


def draw_pairs(pairs: Sequence[Pair], space: LabelSpace) -> Image.Image:
    """A row of queries of one size, at least one, above a row of their best matches, framed green
    if right and red if wrong."""
    queries = [_tile(pair.query, space, pair.query_name, _QUERY) for pair in pairs]
    matches = [
        _tile(pair.match, space, f"right: {pair.match_name}", _RIGHT)
        if pair.right
        else _tile(pair.match, space, f"WRONG: {pair.match_name}", _WRONG)
        for pair in pairs
    ]
    rows = [np.hstack([np.asarray(tile) for tile in row]) for row in (queries, matches)]
    return Image.fromarray(np.vstack(rows))


def _tile(labels: LabelMap, space: LabelSpace, name: str, colour: tuple[int, ...]) -> Image.Image:
    """A label map in a frame of a colour, below its name."""
    picture = Image.fromarray(colourise(labels, space))
    size = (round(picture.width * _HEIGHT / picture.height), _HEIGHT)
    picture = picture.resize(size, Image.Resampling.NEAREST)
    tile = ImageOps.expand(picture, (_FRAME, _TEXT + 2 * _FRAME, _FRAME, _FRAME), colour)
    font = ImageFont.load_default(_TEXT)
    ImageDraw.Draw(tile).text((_FRAME, _FRAME - 1), name, fill="white", font=font)
    return tile
