"""The method on generated data: two drives through a synthetic city."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..channels.label_shapes import LabelShapes
from ..config import SSRVLADConfig
from ..database.database import Database
from ..datasets.label_files import find_label_files, read_label_map
from ..datasets.synthetic_city import write_city
from ..descriptor import SSRVLAD
from ..encoding.encoder import encode_to_database, encode_to_memory
from ..encoding.results import EncodeOptions
from ..evaluation.ground_truth_files import from_file, known_matches
from ..evaluation.metrics import evaluate
from ..files import empty_folder, replacing
from ..recognition.matching import match
from ..taxonomy import label_space
from .pairs import Pair, chosen, draw_pairs

LABELS_AS = "cityscapes-trainids"
PICTURED = 4
STEPS = 4
"""Steps of work for each frame: two to render, one to encode, one to query."""

_ABOVE = "Queries: the second drive, in winter, beside the first track, with poor labels"
_BELOW = "Best match of each in the first drive"


def run_demo(
    out: Path, frames: int, seed: int, progress: Callable[[int], None]
) -> tuple[dict[str, Any], Path]:
    """Renders a city, encodes the first drive, recognises the second one, draws the result:
    ``city/``, ``city.ssrdb`` and ``demo.png`` in a new or empty folder. ``progress`` is called with
    the number of further steps that are done, `STEPS` for each frame. Returns the metrics of
    `evaluate` with ``references`` and ``fingerprint``, and the picture."""
    city = empty_folder(out) / "city"
    write_city(city, frames=frames, seed=seed, progress=progress)
    head = SSRVLAD(SSRVLADConfig.from_preset("default", labels_as=LABELS_AS))

    database = Database.create(out / "city.ssrdb", head.config)
    reference_files = find_label_files([str(city / "reference")])
    query_files = find_label_files([str(city / "query")])
    encode_to_database(head, reference_files, database, EncodeOptions(progress=progress))
    channel, space = LabelShapes(head), head.label_space
    queries, _ = encode_to_memory([channel], space, query_files, progress=progress)
    references = database.load()

    scores, rows = match(queries.descriptors, references.descriptors, top=10)
    _, truth = known_matches(
        from_file(city / "ground_truth.json", queries.frames, references.frames)
    )
    metrics = evaluate(scores.numpy(), rows.numpy(), truth)
    metrics["references"] = len(references.frames)
    metrics["fingerprint"] = database.fingerprint

    best = rows[:, 0].tolist()
    right = [row in matches for row, matches in zip(best, truth, strict=True)]
    space = label_space(LABELS_AS)
    pairs = [
        Pair(
            read_label_map(query_files[n], space),
            read_label_map(reference_files[best[n]], space),
            query_files[n].frame,
            f"{reference_files[best[n]].frame}, cosine {scores[n, 0]:.2f}",
            right[n],
        )
        for n in chosen(right, [row >= 0 for row in best], PICTURED)
    ]
    picture = out / "demo.png"
    with replacing(picture) as temporary:
        draw_pairs(pairs, space, _ABOVE, _BELOW).save(temporary, format="PNG")
    return metrics, picture
