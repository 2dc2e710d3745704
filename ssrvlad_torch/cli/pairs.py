"""A picture of queries above their best matches."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from ..datasets.label_files import LabelMap
from ..taxonomy import LabelSpace, colourise

_HEIGHT = 240
_MARGIN, _FRAME = 14, 5
_HEADING, _TEXT = 24, 18
_QUERY, _RIGHT, _WRONG = (90, 98, 110), (26, 127, 55), (207, 34, 46)


class Pair(NamedTuple):
    """A query and its best match, ``(H, W)`` label ids, their titles, and whether it is right."""

    query: LabelMap
    match: LabelMap
    query_name: str
    match_name: str
    right: bool


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
    rows: list[list[Image.Image]] = [[], []]
    for pair in pairs:
        verdict, colour = ("right", _RIGHT) if pair.right else ("WRONG", _WRONG)
        rows[0].append(_tile(pair.query, space, pair.query_name, _QUERY))
        rows[1].append(_tile(pair.match, space, f"{verdict}: {pair.match_name}", colour))
    wide, tall = (max(tile.size[axis] for row in rows for tile in row) for axis in (0, 1))
    width = len(pairs) * (wide + _MARGIN) + _MARGIN
    ids = {label for pair in pairs for labels in pair[:2] for label in np.unique(labels).tolist()}
    legend = _legend(width - 2 * _MARGIN, space, ids)
    step = _HEADING + tall + 2 * _MARGIN
    sheet = Image.new("RGB", (width, 2 * step + legend.height + 2 * _MARGIN), "white")
    draw = ImageDraw.Draw(sheet)
    for number, (heading, row) in enumerate(zip((above, below), rows, strict=True)):
        top = number * step + _MARGIN
        draw.text((_MARGIN, top), heading, fill="black", font=ImageFont.load_default(_HEADING))
        for column, tile in enumerate(row):
            sheet.paste(tile, (_MARGIN + column * (wide + _MARGIN), top + _HEADING + _MARGIN))
    sheet.paste(legend, (_MARGIN, 2 * step + _MARGIN))
    return sheet


def _tile(labels: LabelMap, space: LabelSpace, name: str, colour: tuple[int, ...]) -> Image.Image:
    picture = Image.fromarray(colourise(labels, space))
    size = (round(picture.width * _HEIGHT / picture.height), _HEIGHT)
    picture = picture.resize(size, Image.Resampling.NEAREST)
    top = _TEXT + 2 * _FRAME
    tile = ImageOps.expand(picture, (_FRAME, top, _FRAME, _FRAME), colour)
    font = ImageFont.load_default(_TEXT)
    draw = ImageDraw.Draw(tile)
    while draw.textlength(name, font) > size[0] and name != "...":
        name = name.removesuffix("...")[:-1] + "..."
    draw.text((_FRAME, _FRAME - 1), name, fill="white", font=font)
    return tile


def _legend(width: int, space: LabelSpace, ids: set[int]) -> Image.Image:
    """The classes of these ids with their colours, on as many lines as needed."""
    font, line = ImageFont.load_default(_TEXT), _TEXT + 8
    places, x, y = [], 0, 0
    for label in space.classes:
        if label.id not in ids:
            continue
        long = _TEXT + 8 + int(font.getlength(label.name)) + _MARGIN
        if x + long > width:
            x, y = 0, y + line
        places.append((x, y, label))
        x += long
    legend = Image.new("RGB", (width, y + line), "white")
    draw = ImageDraw.Draw(legend)
    for x, y, label in places:
        draw.rectangle((x, y + 3, x + _TEXT, y + 3 + _TEXT), fill=label.colour or (0, 0, 0))
        draw.text((x + _TEXT + 6, y + 2), label.name, fill="black", font=font)
    return legend
