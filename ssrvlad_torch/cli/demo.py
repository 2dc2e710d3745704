"""The main job on generated data: two drives through a synthetic city, recognised."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..config import SSRVLADConfig
from ..database.database import Database
from ..datasets.label_files import LabelFile, find_label_files, read_label_map
from ..datasets.synthetic_city import write_city
from ..descriptor import SSRVLAD
from ..encoding.encoder import encode_to_database, encode_to_memory
from ..encoding.results import EncodeOptions
from ..evaluation.ground_truth_files import from_file, of_known
from ..evaluation.metrics import evaluate
from ..files import empty_folder, replacing
from ..recognition.matching import match
from ..taxonomy import VOID, colourise, label_space

LABELS_AS = "cityscapes-trainids"
PICTURED = 8
STEPS = 4
"""Rounds of work for each frame: two to render, one to encode, one to query."""

_MARGIN = 10
_FRAME = 4
_LINE = 20
_TITLE = (
    "Above: the second drive, in winter, beside the first track, with other cars and poor labels. "
    "Below: its best match in the first drive."
)
_RIGHT, _WRONG = (40, 160, 60), (210, 40, 40)


class Recognition(NamedTuple):
    """A query, its best candidate with the score, and whether it shows the place."""

    query: LabelFile
    reference: LabelFile
    score: float
    right: bool


@dataclass(frozen=True)
class DemoResult:
    """The metrics as `evaluate` gives them, with ``references`` and ``fingerprint``."""

    metrics: dict[str, Any]
    picture: Path


def run_demo(out: Path, frames: int, seed: int, progress: Callable[[int], None]) -> DemoResult:
    """Renders a city, encodes the reference drive, recognises the query drive, draws the result.

    Args:
        out: folder, new or empty, that gets ``city/``, ``city.ssrdb`` and ``demo.png``.
        frames: frames of each drive.
        seed: of the city.
        progress: told of the steps that are done, `STEPS` a frame in all.

    Raises:
        OSError: ``out`` cannot be written.
    """
    city = empty_folder(out) / "city"
    write_city(city, frames=frames, seed=seed, progress=progress)
    head = SSRVLAD(SSRVLADConfig.from_preset("default", labels_as=LABELS_AS))

    database = Database.create(out / "city.ssrdb", head.config)
    reference_files = find_label_files([str(city / "reference")])
    query_files = find_label_files([str(city / "query")])
    encode_to_database(head, reference_files, database, EncodeOptions(progress=progress))
    queries, _ = encode_to_memory(head, query_files, progress=progress)
    references = database.load()

    scores, rows = match(queries.descriptors, references.descriptors, top=10)
    _, truth = of_known(from_file(city / "ground_truth.json", queries.frames, references.frames))
    metrics = evaluate(scores.numpy(), rows.numpy(), truth)
    metrics["references"] = len(references.frames)
    metrics["fingerprint"] = database.fingerprint

    recognised = [
        Recognition(query, reference_files[row], float(score), row in matches)
        for query, row, score, matches in zip(
            query_files, rows[:, 0].tolist(), scores[:, 0], truth, strict=True
        )
        if row >= 0
    ]
    picture = out / "demo.png"
    with replacing(picture) as temporary:
        draw_recognitions(recognised).save(temporary, format="PNG")
    return DemoResult(metrics, picture)


def draw_recognitions(recognised: Sequence[Recognition]) -> Image.Image:
    """Some of the queries, evenly spread over the drive, each above its best candidate, framed
    green if that is right and red if it is wrong; a wrong one is among them if there is one."""
    tiles = [_tile(recognition) for recognition in _chosen(recognised)]
    columns = -(-len(tiles) // 2)
    width, height = (max(tile.size[axis] for tile in tiles) + _MARGIN for axis in (0, 1))
    legend = _legend(columns * width)
    top = _LINE + 2 * _MARGIN
    size = columns * width + _MARGIN, top + 2 * height + legend.height + _MARGIN
    sheet = Image.new("RGB", size, "white")
    ImageDraw.Draw(sheet).text((_MARGIN, _MARGIN), _TITLE, fill="black", font=_font())
    for number, tile in enumerate(tiles):
        row, column = divmod(number, columns)
        sheet.paste(tile, (column * width + _MARGIN, top + row * height))
    sheet.paste(legend, (_MARGIN, top + 2 * height))
    return sheet


def _chosen(recognised: Sequence[Recognition]) -> list[Recognition]:
    places = np.linspace(0, len(recognised) - 1, min(PICTURED, len(recognised))).astype(int)
    chosen = [recognised[place] for place in places]
    wrong = [recognition for recognition in recognised if not recognition.right]
    if wrong and all(recognition.right for recognition in chosen):
        chosen[-1] = wrong[-1]
    return chosen


def _tile(recognition: Recognition) -> Image.Image:
    space = label_space(LABELS_AS)
    above, below = (
        Image.fromarray(colourise(read_label_map(file, space), LABELS_AS))
        for file in (recognition.query, recognition.reference)
    )
    width, height = above.size
    right = recognition.right
    tile = Image.new(
        "RGB", (width + 2 * _FRAME, 2 * (height + _LINE) + 2 * _FRAME), _RIGHT if right else _WRONG
    )
    tile.paste(above, (_FRAME, _LINE))
    tile.paste(below, (_FRAME, height + 2 * _LINE))
    verdict = "right" if right else "wrong"
    match_of = f"{recognition.reference.frame}  {recognition.score:.2f}, {verdict}"
    draw = ImageDraw.Draw(tile)
    draw.text((_FRAME, 2), recognition.query.frame, fill="white", font=_font())
    draw.text((_FRAME, height + _LINE + 2), match_of, fill="white", font=_font())
    return tile


def _legend(width: int) -> Image.Image:
    """The classes and their colours, in as many lines as it takes."""
    draw = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    places, x, y = [], 0, 0
    for label in label_space(LABELS_AS).classes:
        if label.colour is None or label.category == VOID:
            continue
        long = _LINE + int(draw.textlength(label.name, _font())) + 2 * _MARGIN
        if x + long > width:
            x, y = 0, y + _LINE
        places.append((x, y, label))
        x += long
    legend = Image.new("RGB", (width, y + _LINE), "white")
    draw = ImageDraw.Draw(legend)
    for x, y, label in places:
        draw.rectangle((x, y + 4, x + _LINE - 8, y + _LINE - 4), fill=label.colour)
        draw.text((x + _LINE - 3, y + 2), label.name, fill="black", font=_font())
    return legend


def _font() -> Any:
    return ImageFont.load_default(13)
