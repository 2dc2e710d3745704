"""Methods as they are published, on data sets of any layout: pages of the paper and of methods.

CamVid, odd against even: the even frames of all sequences are the references, the odd frames the
queries, and a query's true matches are its neighbours in the drive.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _costs import Cost
from _decide import Decisions, decide
from _described import IMAGES, LABELS, OF_NETWORKS, OF_PICTURES, TRAINED, Condition, Described
from _timing import threads
from conditions import Search, camvid, every_other, labelled, pictured

from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.datasets.dataset import Dataset
from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers
from ssrvlad_torch.evaluation.true_matches import Viewpoints, true_matches
from ssrvlad_torch.recognition.recognise import AS_PAPER
from ssrvlad_torch.segmentation.segmenter import Segmenter

CAMVID = "CamVid, odd against even"


class Rival(NamedTuple):
    """A row of a table: a method of `_described.py`, and t of the sum over references (Eq. 3)."""

    name: str
    method: str
    reach: int = 0

    @property
    def sees(self) -> str:
        """`LABELS` or `IMAGES`."""
        return IMAGES if self.method in OF_PICTURES else LABELS


Outcome = Decisions | str
"""Candidates of a method, or the reason why it could not run."""

Outcomes = dict[tuple[str, str], Outcome]
"""Outcomes by the title of a condition and the name of a rival."""


def try_all(
    described: Described, conditions: Iterable[Condition], rivals: Iterable[Rival]
) -> Outcomes:
    """Runs every rival on every condition whose frames it can use; prints a line for each."""
    pairs = [(c, r) for c in conditions for r in rivals if r.sees == c.gives]
    outcomes: Outcomes = {}
    for number, (condition, rival) in enumerate(pairs, 1):
        begin = time.perf_counter()
        try:
            found: Outcome = decide(described, condition, rival.method, AS_PAPER, rival.reach)
        except (FileNotFoundError, ImportError, ValueError) as error:
            found = str(error).replace(str(Path.home()), "~")
        outcomes[condition.title, rival.name] = found
        where = f"{number} of {len(pairs)}, {time.perf_counter() - begin:.0f} s"
        summary = found if isinstance(found, str) else f"{found.right.mean():.3f} of all right"
        print(f"[{where}] {condition.title}: {rival.name}: {summary}", flush=True)
    return outcomes


def without(outcomes: Outcomes) -> Iterator[str]:
    """Lines about the rivals that could not run."""
    reasons = {rival: text for (_, rival), text in outcomes.items() if isinstance(text, str)}
    yield from (f"- {rival}: {reason}." for rival, reason in reasons.items())
    yield ""


def reason(outcome: str) -> str:
    """Why a rival could not run, in a cell of a table."""
    return "weights not here" if outcome.startswith("no weights") else "not run"


def costs(
    described: Described,
    methods: Iterable[str],
    frames: Sequence[View],
    references: int,
    rounds: tuple[int, int],
) -> dict[str, Cost]:
    """Costs of methods by their names, on one thread. One frame is encoded and matched by every
    method, then the next frame by every method, and after the last the first again, in so many
    rounds, and rounds of trained networks; one more before them is not counted. Without weights
    these have random ones; features and LoST-X need a network. `_costs.ENCODED` references are
    encoded; if an encoding is one tensor, it is repeated up to ``references``."""
    able = [name for name in methods if name not in OF_NETWORKS or described.network]
    with threads(1):
        made = {name: described.make(name, random_weights=True) for name in able}
        found = {name: Cost(method, frames, references) for name, method in made.items()}
        for number in range(-1, max(rounds)):
            for name, cost in found.items():
                if number < rounds[name in TRAINED]:
                    cost.work(number)
            print(f"[round {number + 2} of {max(rounds) + 1}]", flush=True)
    return found


def shown(name: str, cost: Cost) -> str:
    """The method's name in a table of costs."""
    return f"{name} (random weights)" if "random" in cost.method else name


def camvid_trials(described: Described, folder: Path) -> list[Condition]:
    """Hand-made labels, a network's labels against them, and the images."""
    for kind in ("labels", "predicted_espnetv2"):
        described.added[f"camvid {kind}"] = partial(camvid, folder, kind)
    names, _ = described.about("camvid labels")
    odd, even = every_other(names, 1), every_other(names, 0)
    truth = from_frame_numbers(*([names[row] for row in rows] for rows in (odd, even)), 1)
    return [
        Condition(CAMVID, name, [Search(f"camvid {kind}", "camvid labels", truth, odd, even)])
        for name, kind in (
            ("labels -> labels", "labels"),
            ("espnetv2 -> labels", "predicted_espnetv2"),
            ("images -> images", "labels"),
        )
    ]


def trial_of(
    described: Described,
    name: str,
    kind: str,
    parts: Sequence[Dataset],
    segmenter: Segmenter | None = None,
) -> Condition:
    """Two parts of a data set, queries and references, by its images, by its label maps, or by
    those of a segmenter.

    Raises:
        ValueError: the data set has no ground truth, or it does not fit the frames.
    """
    if (truth := parts[0].truth) is None:
        raise ValueError("; ".join(parts[0].notes) or f"{parts[0].root} has no ground truth")
    own = kind == LABELS and segmenter is None
    drives, places = [], []
    for part in parts:
        files = part.label_files() if own else part.image_files()
        stats = [(file.frame, file.path.stat()) for file in files]
        stamp = repr([(frame, stat.st_size, stat.st_mtime_ns) for frame, stat in stats])
        drive = f"{name} {kind} {blake2b(stamp.encode(), digest_size=8).hexdigest()}"
        read = partial(labelled, files, str(part.labels_as)) if own else partial(pictured, files)
        described.add(drive, files, cache(read if segmenter is None else partial(read, segmenter)))
        drives.append(drive)
        places.append(Viewpoints.of(files))
    word = "segmented" if segmenter else kind
    known = true_matches(truth, places[1], places[0], print)
    rows = [np.zeros(0, np.int64) if rows is None else rows for rows in known]
    return Condition(name, f"{word} -> {word}", [Search(*drives, rows)])
