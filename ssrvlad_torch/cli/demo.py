"""The main job on generated data: two drives through a synthetic city, recognised."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

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
from ..taxonomy import colourise, label_space

LABELS_AS = "cityscapes-trainids"
PICTURED = 8
STEPS = 4
"""Rounds of work for each frame: two to render, one to encode, one to query."""

_MARGIN = 10
_FRAME = 4
_CAPTION = 14
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
    green if that is right and red if it is wrong."""
    chosen = np.linspace(0, len(recognised) - 1, min(PICTURED, len(recognised))).astype(int)
    tiles = [_tile(recognised[index]) for index in chosen]
    columns = -(-len(tiles) // 2)
    width, height = (max(tile.size[axis] for tile in tiles) + _MARGIN for axis in (0, 1))
    sheet = Image.new("RGB", (columns * width + _MARGIN, 2 * height + _MARGIN), "white")
    for number, tile in enumerate(tiles):
        row, column = divmod(number, columns)
        sheet.paste(tile, (column * width + _MARGIN, row * height + _MARGIN))
    return sheet


def _tile(recognition: Recognition) -> Image.Image:
    space = label_space(LABELS_AS)
    above, below = (
        Image.fromarray(colourise(read_label_map(file, space), LABELS_AS))
        for file in (recognition.query, recognition.reference)
    )
    colour = _RIGHT if recognition.right else _WRONG
    width, height = above.size
    tile = Image.new("RGB", (width + 2 * _FRAME, 2 * height + 3 * _FRAME + _CAPTION), colour)
    tile.paste(above, (_FRAME, _CAPTION + _FRAME))
    tile.paste(below, (_FRAME, _CAPTION + height + 2 * _FRAME))
    verdict = "right" if recognition.right else "wrong"
    caption = f"{recognition.query.frame} -> {recognition.reference.frame}"
    ImageDraw.Draw(tile).text(
        (_FRAME, 2), f"{caption}  {recognition.score:.3f}  {verdict}", fill="white"
    )
    return tile
