"""Trials: a method on a problem, cached so that an interrupted run can be resumed."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from _problems import LABELS, Problem, Search, stamp_of

import ssrvlad_torch
from ssrvlad_torch import SSRVLADConfig, baselines
from ssrvlad_torch.baselines.run import run
from ssrvlad_torch.baselines.weights import weights_folder
from ssrvlad_torch.cli.output import progress_bar
from ssrvlad_torch.evaluation.curves import PrecisionRecall
from ssrvlad_torch.evaluation.metrics import Convention, evaluate, precision_recall_curve
from ssrvlad_torch.evaluation.outcomes import Rows, judge
from ssrvlad_torch.files import replacing

TOP = 10
BLOCK = 16
RESAMPLES = 1000
TRAINED = ("netvlad", "region-vlad")
"""Methods whose networks were trained."""

LOST_X = "lost-x"
"""A method that runs any segmentation network."""

UNPROCESSED = {"opening": 0.0, "closing": 0.0, "hole_area": 0.0, "region_area": 0.0}
"""SSR-VLAD without the paper's pre-processing of the label map."""


@dataclass(frozen=True)
class Rival:
    """A method with its settings, a row of a table.

    Attributes:
        name: in the tables.
        method: its name in `baselines.METHODS`.
        sees: `LABELS` or `IMAGES`.
        settings: for `baselines.make`.
    """

    name: str
    method: str
    sees: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def ssrvlad(cls, name: str, preset: str, temporal: int, **settings: Any) -> Rival:
        """SSR-VLAD."""
        own = {"preset": preset, "temporal": temporal, **settings}
        return cls(name, "ssr-vlad", LABELS, own)

    def make(self, weights: Path | None = None, random_weights: bool = False) -> baselines.Method:
        """The method.

        Args:
            weights: folder of the weights of trained networks.
            random_weights: use random weights if there are no others.

        Raises:
            FileNotFoundError: there are no weights.
            ImportError: an extra is missing.
        """
        if self.method not in TRAINED:
            return baselines.make(self.method, **self.settings)
        places = {"weights": weights} if weights else {}
        if weights and self.method == "region-vlad":
            places["vocabulary"] = weights
        try:
            return baselines.make(self.method, **places, **self.settings)
        except FileNotFoundError:
            if not random_weights:
                raise
            return baselines.make(self.method, random_weights=True, **self.settings)

    def stamp(self, weights: Path | None) -> str:
        """Text that changes with the settings, the fingerprint of a preset, and the weights."""
        parts: list[Any] = [self.method, sorted(self.settings.items())]
        if self.method == "ssr-vlad":
            settings = {key: value for key, value in self.settings.items() if key != "temporal"}
            parts.append(SSRVLADConfig.from_preset(**settings).fingerprint)
        if self.method in TRAINED:
            folder = weights or weights_folder()
            files = sorted(path for path in folder.rglob("*") if path.is_file())
            parts += [(path.name, *stamp_of(path)) for path in files]
        return repr(parts)


def with_network(rivals: Iterable[Rival], network: Path | None) -> tuple[Rival, ...]:
    """The rivals, LoST-X with a segmentation network if there is one."""
    settings = {"network": str(network)} if network else {}
    return tuple(replace(r, settings=settings) if r.method == LOST_X else r for r in rivals)


def with_costs(rivals: Iterable[Rival]) -> tuple[Rival, ...]:
    """The rivals without LoST-X if it has no network: it cannot run with random weights."""
    return tuple(rival for rival in rivals if rival.method != LOST_X or rival.settings)


@dataclass(frozen=True)
class Trial:
    """Candidates of a method.

    Attributes:
        scores, indices: ``(Q, top)`` over all queries; references count through all searches.
        truth: true matches of each query.
        references: their number in all searches.
        bytes_a_reference: size of an encoded reference.
    """

    scores: np.ndarray
    indices: Rows
    truth: list[Rows]
    references: int
    bytes_a_reference: float

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Trial:
        """Reads a record of `to_record`."""
        return cls(
            np.array(record["scores"], np.float32),
            np.array(record["indices"], np.int64),
            [np.array(rows, np.int64) for rows in record["truth"]],
            record["references"],
            record["bytes_a_reference"],
        )

    def to_record(self) -> dict[str, Any]:
        """A record for JSON."""
        return {
            "scores": self.scores.tolist(),
            "indices": self.indices.tolist(),
            "truth": [rows.tolist() for rows in self.truth],
            "references": self.references,
            "bytes_a_reference": self.bytes_a_reference,
        }

    def figures(self, convention: Convention) -> dict[str, Any]:
        """All figures with intervals, see `evaluate`."""
        return evaluate(
            self.scores,
            self.indices,
            self.truth,
            at=(1, 5),
            convention=convention,
            resamples=RESAMPLES,
        )

    def curve(self, convention: Convention) -> PrecisionRecall:
        """Precision and recall."""
        outcomes = judge(self.scores, self.indices, self.truth)
        return precision_recall_curve(outcomes, self.truth, convention)


Outcome = Trial | str
"""Candidates of a method, or the reason why it could not run."""

Outcomes = dict[tuple[str, str], Outcome]
"""Outcomes by the names of problem and rival."""


class Cache:
    """Results as JSON files in a folder, by a digest of their origin.

    The origin includes the source of the package: another version makes new results.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, origin: Iterable[Any], make: Callable[[], Any]) -> Any:
        """The cached result, or a new one."""
        text = repr([_source(), *origin])
        digest = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
        file = self.folder / f"{digest}.json"
        if not file.exists():
            made = json.dumps(make())
            with replacing(file) as temporary:
                temporary.write_text(made, encoding="utf-8")
        return json.loads(file.read_text(encoding="utf-8"))


@cache
def _source() -> str:
    """A digest of the package."""
    content = hashlib.blake2b(digest_size=16)
    for path in sorted(Path(ssrvlad_torch.__file__).parent.rglob("*")):
        if path.suffix in (".py", ".yaml"):
            content.update(path.read_bytes())
    return content.hexdigest()


def try_all(
    problems: Iterable[Problem], rivals: Iterable[Rival], results: Cache, weights: Path | None
) -> Outcomes:
    """Runs every rival on every problem whose frames it can use; prints a line for each."""
    pairs = [(p, r) for p in problems for r in rivals if r.sees == p.gives]
    outcomes: Outcomes = {}
    for number, (problem, rival) in enumerate(pairs, 1):
        begin = time.perf_counter()
        outcome = outcomes[problem.name, rival.name] = _try(problem, rival, results, weights)
        summary = outcome if isinstance(outcome, str) else _in_short(outcome)
        where = f"{number} of {len(pairs)}, {time.perf_counter() - begin:.0f} s"
        print(f"[{where}] {problem.name}: {rival.name}: {summary}", flush=True)
    return outcomes


def _in_short(trial: Trial) -> str:
    rate = evaluate(trial.scores, trial.indices, trial.truth, at=(1,))["recall_at"]["1"]
    return f"RecallRate@1 {rate:.3f}"


def _try(problem: Problem, rival: Rival, results: Cache, weights: Path | None) -> Outcome:
    try:
        method = rival.make(weights)
        origin = ("trial", problem.stamp, rival.stamp(weights))
        return Trial.of(results.get(origin, lambda: _run(method, problem).to_record()))
    except (FileNotFoundError, ImportError, ValueError) as error:
        return str(error).replace(str(Path.home()), "~")


def _run(method: baselines.Method, problem: Problem) -> Trial:
    found = [_search(method, search) for search in problem.searches]
    ends = list(accumulate(trial.references for trial in found))
    starts = [0, *ends[:-1]]
    both = list(zip(found, starts, strict=True))
    return Trial(
        np.concatenate([trial.scores for trial in found]),
        np.concatenate([np.where(t.indices < 0, -1, t.indices + start) for t, start in both]),
        [rows + start for trial, start in both for rows in trial.truth],
        ends[-1],
        sum(trial.bytes_a_reference * trial.references for trial in found) / ends[-1],
    )


def _search(method: baselines.Method, search: Search) -> Trial:
    truth = search.truth
    count = sum(len(drive.places[0]) for drive in (search.queries, search.references))
    with progress_bar(method.name, count) as bar:
        found = run(
            method, search.queries, search.references, TOP, block=BLOCK, progress=bar.advance
        )
    return Trial(
        found.scores.numpy(),
        found.indices.numpy(),
        truth,
        len(found.references),
        found.bytes_a_reference,
    )
