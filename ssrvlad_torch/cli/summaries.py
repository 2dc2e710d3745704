"""Metrics, steps and estimates in words, and the page of ``ssrvlad evaluate --report``."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..config import package_version
from ..datasets.dataset import shortened
from ..evaluation.measure import Evaluation
from ..evaluation.metrics import figure_rows, fraction
from ..evaluation.report import render, write_report
from ..evaluation.thresholds import SURE_PRECISION, operating_rows, queries_needed
from ..recognition.confidence import Estimate
from ..recognition.standardise import MIN_FRAMES
from .output import print_table, say, weights_in_words


def print_metrics(metrics: Mapping[str, Any]) -> None:
    """Prints all metrics of `measure` with their intervals, and thresholds to choose from."""
    figures = [(name, fraction(one), fraction(*ends)) for name, one, ends in figure_rows(metrics)]
    print_table(("metric", metrics["convention"], "95 % interval"), figures)
    score = metrics["score_is"] or "score"
    rows: list[tuple[object, ...]] = []
    for name, point in operating_rows(metrics["thresholds"]):
        if point is None:
            rows.append((name, "none"))
            continue
        fractions = (fraction(point[key]) for key in ("precision", "precision_low", "recall"))
        rows.append((name, f"{point['score']:.4f}", *fractions, point["accepted"]))
    print_table(("threshold for", score, "precision", "lower bound", "recall", "accepted"), rows)
    say(suggestion(metrics))
    for line in without_truth(metrics):
        say(line)
    say(counts(metrics))


def write_page(path: Path, evaluation: Evaluation, database: str, sources: Sequence[str]) -> None:
    """Writes the page of an evaluation, with the names of the database and of the sources of the
    queries."""
    metrics, skipped = evaluation.metrics, evaluation.recognition.skipped
    names = shortened(["/".join(Path(source).parts[-2:]) or source for source in sources])
    settings = {
        "preset": metrics["preset"],
        "references": database,
        "queries": shortened(sources),
        "true matches": evaluation.true_matches,
        "fingerprint": metrics["fingerprint"],
        "steps": steps_in_words(metrics["steps"], metrics["temporal"]),
        "score is": metrics["score_is"],
        "ssrvlad-torch": package_version(),
    }
    notes = []
    if unknown := evaluation.left_out:
        count = len(evaluation.truth) + unknown
        notes.append(f"{unknown} of {count} queries are left out: no true matches are known")
    if skipped:
        first = f"{skipped[0].frame}: {skipped[0].reason}"
        notes.append(f"{len(skipped)} more queries were skipped, the first is {first}")
    notes += [suggestion(metrics), *without_truth(metrics)]
    title = f"{names} against {Path(database).name or database}"
    write_report(path, render(evaluation, title, settings, notes))


def counts(metrics: Mapping[str, Any]) -> str:
    """The number of queries and references, and the steps, in a line."""
    steps = metrics.get("steps")
    steps_line = steps_in_words(steps, metrics["temporal"]) if steps else "single frames"
    return (
        f"{metrics['queries']} queries ({metrics['queries_with_match']} with a true match) against "
        f"{metrics['references']} references, {steps_line}, fingerprint {metrics['fingerprint']}"
    )


def suggestion(metrics: Mapping[str, Any]) -> str:
    """The lower bound of the precision at the suggested threshold, and what a higher one needs."""
    suggested = metrics["thresholds"]["suggested"]
    missing = (
        f"a lower bound of {SURE_PRECISION:g} needs at least {queries_needed()} accepted queries "
        "without a mistake"
    )
    if suggested is None:
        return f"suggested: no threshold, no query was recognised; {missing}"
    low = suggested["precision_low"]
    bound = (
        f"suggested: {suggested['score']:.4f}, lower bound of the precision {low:.3f} by "
        f"{suggested['accepted']} accepted queries, if they were independent and the threshold "
        "were fixed before"
    )
    return bound if low >= SURE_PRECISION else f"{bound}; {missing}"


def without_truth(metrics: Mapping[str, Any]) -> Iterator[str]:
    """The estimates for the accepted answers, beside the truth; nothing for other methods."""
    for name, stored in metrics.get("estimates", {}).items():
        truth, judged = stored["truly_wrong"], stored["of_known_truth"]
        of = f" of {judged} whose truth is known" if judged != stored["accepted"] else ""
        true = "" if truth is None else f"; in truth {truth:.1%}{of}"
        estimate = Estimate(*(stored[field] for field in Estimate._fields))
        suggested = "suggested " if name != "accepted" else ""
        yield f"{suggested}without ground truth: {estimate_in_words(estimate)}{true}"


def estimate_in_words(estimate: Estimate) -> str:
    """How many answers are accepted, and how many of them are wrong without ground truth."""
    if not estimate.accepted:
        return "no answer is accepted"
    answers = f"{estimate.accepted} answer{'s' * (estimate.accepted != 1)}"
    if estimate.confidence:
        answers = f"accepted {answers} of confidence {estimate.confidence:.2f} and more"
    if estimate.low is None:
        few = "they are too few, or too unclear," if estimate.wrong < 1 else "too few references"
        return f"{answers}; {few} to say how many are wrong"
    interval = f"95 % interval {estimate.low:.1%} to {estimate.high:.1%}"
    return f"{answers}; {estimate.wrong:.1%} estimated to be wrong ({interval})"


def steps_in_words(
    used: Mapping[str, Any],
    temporal: int | None = None,
    estimate: Estimate | None = None,
) -> str:
    """The steps between descriptors and a decision, in a line; those of Eq. 3, and how many answers
    are accepted, only if given."""
    widths, standard, near = used["sweep"].values(), used["standardise"], used.get("near")
    if not widths:
        return "no query could be described"
    columns = "/".join(map(str, dict.fromkeys(widths)))
    words = [used["index"]] if used.get("index") else []
    words += [f"candidates {near}"] if near else []
    words += [
        by_sequence({k: "standardised" if v else "not standardised" for k, v in standard.items()}),
        f"sweep +-{columns} columns" if any(widths) else "no sweep",
        f"followed: {by_sequence(used['follow'])}",
        *weights_in_words(list(used["weights"].values())),
    ]
    if used["delay"]:
        words.append(f"answers wait for {used['delay']} queries")
    if temporal is not None:
        words.append(f"temporal sum t = {temporal}" if temporal else "no temporal sum")
    if used["references"] < MIN_FRAMES:
        words.append(f"no confidence: {used['references']} references are too few")
    steps = ", ".join(words)
    return f"{steps}; {estimate_in_words(estimate)}" if estimate else steps


def by_sequence(values: Mapping[str, str]) -> str:
    """What holds for each sequence; the names of the sequences only where they differ."""
    names: dict[str, list[str]] = {}
    for name, value in values.items():
        names.setdefault(value, []).append(name)
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{value} ({shortened(of, most=3)})" for value, of in names.items())
