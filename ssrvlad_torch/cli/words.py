"""Metrics, steps and estimates in words."""

from collections.abc import Iterator, Mapping
from typing import Any

from ..datasets.dataset import shortened
from ..evaluation.metrics import figure_rows, fraction
from ..evaluation.thresholds import SURE_PRECISION, operating_rows, queries_needed
from ..recognition.confidence import Estimate
from ..recognition.standardise import MIN_FRAMES
from .output import print_table, say, weights_in_words


def print_metrics(metrics: Mapping[str, Any]) -> None:
    """Prints all metrics of `measure` with their intervals, and thresholds to choose from."""
    figures = ((name, fraction(one), fraction(*ends)) for name, one, ends in figure_rows(metrics))
    print_table(("metric", metrics["convention"], "95 % interval"), figures)
    score = metrics["score_is"] or "score"
    head = ("threshold for", score, "precision", "lower bound", "recall", "accepted")
    keys = ("precision", "precision_low", "recall")
    print_table(head, (
        (name, f"{point['score']:.4f}", *(fraction(point[key]) for key in keys), point["accepted"])
        if point
        else (name, "none")
        for name, point in operating_rows(metrics["thresholds"])
    ))  # fmt: skip
    say(lower_bound(metrics["thresholds"]["suggested"]))
    for line in without_truth(metrics):
        say(line)
    say(counts(metrics))


def counts(metrics: Mapping[str, Any]) -> str:
    """The number of queries and references, and the steps, in a line."""
    steps = metrics.get("steps")
    done = steps_in_words(steps, metrics["temporal"]) if steps else "single frames"
    return (
        f"{metrics['queries']} queries ({metrics['queries_with_match']} with a true match) against "
        f"{metrics['references']} references, {done}, fingerprint {metrics['fingerprint']}"
    )


def lower_bound(suggested: Mapping[str, Any] | None) -> str:
    """The lower bound of the precision at the suggested threshold, and what a higher one needs."""
    missing = f"a lower bound of {SURE_PRECISION:g} needs at least {queries_needed()} "
    missing += "accepted queries without a mistake"
    if suggested is None:
        return f"suggested: no threshold, no query was recognised; {missing}"
    low = suggested["precision_low"]
    bound = f"suggested: {suggested['score']:.4f}, lower bound of the precision {low:.3f} by "
    bound += (
        f"{suggested['accepted']} accepted queries, if they were independent and the threshold "
    )
    bound += "were fixed before"
    return bound if low >= SURE_PRECISION else f"{bound}; {missing}"


def without_truth(metrics: Mapping[str, Any]) -> Iterator[str]:
    """The estimates for the accepted answers, beside the truth; nothing for other methods."""
    for name, found in metrics.get("estimates", {}).items():
        truth, judged = found["truly_wrong"], found["of_known_truth"]
        of = f" of {judged} whose truth is known" if judged != found["accepted"] else ""
        true = "" if truth is None else f"; in truth {truth:.1%}{of}"
        guess = Estimate(*(found[field] for field in Estimate._fields))
        suggested = "suggested " if name != "accepted" else ""
        yield f"{suggested}without ground truth: {estimate_in_words(guess)}{true}"


def estimate_in_words(found: Estimate) -> str:
    """How many answers are accepted, and how many of them are wrong without ground truth."""
    if not found.accepted:
        return "no answer is accepted"
    answers = f"{found.accepted} answer{'s' * (found.accepted != 1)}"
    if found.confidence:
        answers = f"accepted {answers} of confidence {found.confidence:.2f} and more"
    if found.low is None:
        few = "they are too few, or too unclear," if found.wrong < 1 else "too few references"
        return f"{answers}; {few} to say how many are wrong"
    wrong = f"{found.wrong:.1%} estimated to be wrong (95 % interval {found.low:.1%} to"
    return f"{answers}; {wrong} {found.high:.1%})"


def steps_in_words(
    used: Mapping[str, Any],
    temporal: int | None = None,
    found: Estimate | None = None,
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
    ]
    words += weights_in_words(list(used["weights"].values()))
    if used["delay"]:
        words.append(f"answers wait for {used['delay']} queries")
    if temporal is not None:
        words.append(f"temporal sum t = {temporal}" if temporal else "no temporal sum")
    if used["references"] < MIN_FRAMES:
        words.append(f"no confidence: {used['references']} references are too few")
    steps = ", ".join(words)
    return f"{steps}; {estimate_in_words(found)}" if found else steps


def by_sequence(values: Mapping[str, str]) -> str:
    """What holds for each sequence; the names of the sequences only where they differ."""
    names: dict[str, list[str]] = {}
    for name, value in values.items():
        names.setdefault(value, []).append(name)
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{value} ({shortened(of, most=3)})" for value, of in names.items())
