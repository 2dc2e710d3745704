"""The method on generated data: two drives through a synthetic city."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..datasets.label_files import find_label_files, read_label_map
from ..datasets.synthetic_city import write_city
from ..encoding.results import EncodeOptions
from ..files import empty_folder, replacing
from ..map import Map
from ..recognition.recognise import Steps
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
    found = town.evaluate(city / "query", alone, ground_truth=truth, progress=progress)

    scores, rows = found.recognition.matches
    best, space = rows[:, 0].tolist(), label_space(LABELS_AS)
    right = found.outcomes.correct.tolist()
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
    return found.metrics | {"steps": None}, picture
