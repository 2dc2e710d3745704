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

_ABOVE = "Queries: the second drive, in winter, beside the first track, with poor labels"
_BELOW = "Best match of each in the first drive"
_HEIGHT, _MARGIN, _FRAME, _HEADING, _TEXT = 240, 14, 5, 24, 18
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
        draw_pairs(pairs, space, _ABOVE, _BELOW).save(temporary, format="PNG")
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


def draw_pairs(pairs: Sequence[Pair], space: LabelSpace, above: str, below: str) -> Image.Image:
    """Draws a row of queries, a row of their best matches, framed green if right and red if wrong,
    and the classes. ``above`` and ``below`` are headings of the rows. At least one pair."""
    queries = [_tile(pair.query, space, pair.query_name, _QUERY) for pair in pairs]
    matches = [
        _tile(pair.match, space, f"right: {pair.match_name}", _RIGHT)
        if pair.right
        else _tile(pair.match, space, f"WRONG: {pair.match_name}", _WRONG)
        for pair in pairs
    ]
    wide = max(tile.width for tile in queries + matches) + _MARGIN
    tall = max(tile.height for tile in queries + matches)
    step = _HEADING + tall + 2 * _MARGIN
    ids = {label for pair in pairs for labels in pair[:2] for label in np.unique(labels).tolist()}
    legend = _legend(len(pairs) * wide - _MARGIN, space, ids)
    height = 2 * step + legend.height + 2 * _MARGIN
    sheet = Image.new("RGB", (len(pairs) * wide + _MARGIN, height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_HEADING)
    for top, heading, tiles in ((0, above, queries), (step, below, matches)):
        draw.text((_MARGIN, top + _MARGIN), heading, fill="black", font=font)
        for column, tile in enumerate(tiles):
            sheet.paste(tile, (_MARGIN + column * wide, top + _HEADING + 2 * _MARGIN))
    sheet.paste(legend, (_MARGIN, 2 * step + _MARGIN))
    return sheet


def _tile(labels: LabelMap, space: LabelSpace, name: str, colour: tuple[int, ...]) -> Image.Image:
    """A label map in a frame of a colour, below its name."""
    picture = Image.fromarray(colourise(labels, space))
    size = (round(picture.width * _HEIGHT / picture.height), _HEIGHT)
    picture = picture.resize(size, Image.Resampling.NEAREST)
    tile = ImageOps.expand(picture, (_FRAME, _TEXT + 2 * _FRAME, _FRAME, _FRAME), colour)
    font = ImageFont.load_default(_TEXT)
    ImageDraw.Draw(tile).text((_FRAME, _FRAME - 1), name, fill="white", font=font)
    return tile


def _legend(width: int, space: LabelSpace, ids: set[int]) -> Image.Image:
    """The classes of these ids with their colours, on as many lines as needed."""
    font, line, x, y = ImageFont.load_default(_TEXT), _TEXT + 8, 0, 0
    classes = [label for label in space.classes if label.id in ids]
    legend = Image.new("RGB", (width, line * len(classes)), "white")
    draw = ImageDraw.Draw(legend)
    for label in classes:
        length = _TEXT + 8 + int(font.getlength(label.name)) + _MARGIN
        if x + length > width:
            x, y = 0, y + line
        draw.rectangle((x, y + 3, x + _TEXT, y + 3 + _TEXT), fill=label.colour or (0, 0, 0))
        draw.text((x + _TEXT + 6, y + 2), label.name, fill="black", font=font)
        x += length
    return legend.crop((0, 0, width, y + line))
