"""Figures of the candidates of a set of queries, however they were found, and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from ..encoding.results import Skipped
from ..evaluation.ground_truth_files import PartialTruth, known_matches
from ..evaluation.metrics import Convention, evaluate, figure_rows, precision_recall_curve
from ..evaluation.outcomes import judge
from ..evaluation.report import Descriptors, Pictures
from ..evaluation.thresholds import SURE_PRECISION, operating_points, queries_needed
from ..recognition.matching import Matches
from ..recognition.standardise import MIN_FRAMES
from .output import figure, fused_in_words, interval, print_table
from .truth import Places

TOP = 10
"""Candidates of each query that the figures need."""

RESAMPLES = 1000


@dataclass(frozen=True)
class Recognition:
    """What was found.

    Attributes:
        references, queries: the frames.
        found: candidates of each query, `TOP` at least.
        similarity: ``(Q, R)`` scores of all pairs, where they are needed.
        descriptors: of the queries and of the references, where a database has them.
        pictures: of the queries and of the references, by their ids.
        skipped: queries that could not be encoded.
        told: how it was found, for the user.
    """

    references: Places
    queries: Places
    found: Matches
    similarity: npt.NDArray[np.float32] | None = None
    descriptors: Descriptors | None = None
    pictures: tuple[Pictures, Pictures] | None = None
    skipped: Sequence[Skipped] = ()
    told: Mapping[str, Any] = field(default_factory=dict)


def wants_similarity(convention: Convention) -> bool:
    """Whether a convention looks at all pairs."""
    return convention.startswith("vpr-tutorial")


def measure(
    recognition: Recognition, matches: PartialTruth, convention: Convention, at_recall: float
) -> dict[str, Any]:
    """All figures with 95 % intervals, thresholds to choose from, and how it was found."""
    known, truth = known_matches(matches)
    scores, rows = (best.numpy()[known] for best in recognition.found)
    pairs = recognition.similarity
    similarity = None if pairs is None else pairs[known]
    metrics = evaluate(
        scores, rows, truth, convention=convention, similarity=similarity, resamples=RESAMPLES
    )
    curve = precision_recall_curve(judge(scores, rows, truth), truth)
    metrics["thresholds"] = operating_points(curve, [at_recall])
    metrics["references"] = len(recognition.references.frames)
    return {**metrics, **recognition.told}


def print_metrics(metrics: Mapping[str, Any]) -> None:
    """All figures with their intervals, and the thresholds to choose from."""
    table = Table("metric", metrics["convention"], "95 % interval")
    for name, value, ends in figure_rows(metrics):
        table.add_row(name, figure(value), interval(ends))
    print_table(table)
    print_table(_thresholds(metrics["thresholds"]))
    print(proof(metrics["thresholds"]["suggested"]))
    print(counts(metrics))


def counts(metrics: Mapping[str, Any]) -> str:
    """How many frames the figures are of, and what found them."""
    steps = metrics.get("steps")
    done = steps_in_words(steps, metrics["temporal"]) if steps else "single frames"
    if "method" in metrics:
        encode, match = (metrics[cost]["average"] for cost in ("encode_ms", "match_ms"))
        whose = f"method {metrics['method']}: {done}; encode {encode:.1f} ms, "
        whose += f"match {match:.1f} ms a single frame"
    else:
        whose = f"{done}, fingerprint {metrics['fingerprint']}"
    return (
        f"{metrics['queries']} queries ({metrics['queries_with_match']} with a true match) against "
        f"{metrics['references']} references, {whose}"
    )


def proof(suggested: Mapping[str, Any] | None) -> str:
    """How sure the precision at the suggested threshold is, and what would prove more."""
    want = f"to prove a precision of {SURE_PRECISION:g} takes at least {queries_needed()} "
    want += "accepted queries without a mistake"
    if suggested is None:
        return f"suggested: no threshold, no query was recognised; {want}"
    low = suggested["precision_low"]
    told = f"suggested: {suggested['score']:.4f}, a precision of at least {low:.3f} is proven by "
    told += f"{suggested['accepted']} accepted queries"
    return told if low >= SURE_PRECISION else f"{told}; {want}"


def steps_in_words(used: Mapping[str, Any], temporal: int | Mapping[str, int] | None = None) -> str:
    """The steps between descriptors and decision, in a line; without ``temporal`` no word on Eq.
    3."""
    widths, followed = used["sweep"].values(), used["follow"].values()
    if not followed:
        return "no query could be described"
    told = [
        "standardised" if any(used["standardise"].values()) else "not standardised",
        f"sweep +-{'/'.join(str(width) for width in dict.fromkeys(widths))} columns"
        if any(widths)
        else "no sweep",
        f"followed: {'/'.join(dict.fromkeys(followed))}",
    ]
    told += fused_in_words(list(used["weights"].values()))
    if used["delay"]:
        told.append(f"answers wait for {used['delay']} queries")
    if temporal is not None:
        ts = temporal.values() if isinstance(temporal, Mapping) else [temporal]
        t = "/".join(map(str, dict.fromkeys(ts)))
        told.append(f"temporal sum t = {t}" if any(ts) else "no temporal sum")
    if used["references"] < MIN_FRAMES:
        told.append(f"{used['references']} references are too few to tell how sure")
    return ", ".join(told)


def _thresholds(points: Mapping[str, Any]) -> Table:
    table = Table("threshold for", "score", "precision", "lower end", "recall", "accepted")
    for kind in ("precision", "recall"):
        for value, point in points[f"at_{kind}"].items():
            table.add_row(f"{kind} {value}", *_point(point))
    table.add_row("suggested", *_point(points["suggested"]))
    return table


def _point(point: Mapping[str, Any] | None) -> list[str]:
    if point is None:
        return ["none"]
    fractions = [figure(point[key]) for key in ("precision", "precision_low", "recall")]
    return [f"{point['score']:.4f}", *fractions, str(point["accepted"])]
