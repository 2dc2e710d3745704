"""Answers, metrics, steps and estimates in words, and the page of ``ssrvlad evaluate --report``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..channels.camera import Camera
from ..config import package_version
from ..datasets.dataset import shortened
from ..datasets.names import sequence_of
from ..datasets.poses import Pose
from ..evaluation.measure import Evaluation
from ..evaluation.metrics import figure_rows, fraction
from ..evaluation.report import render, write_report
from ..evaluation.thresholds import SURE_PRECISION, operating_rows, queries_needed
from ..recognition.sequences import MIN_FRAMES
from ..search.answers import Estimate, estimate_in_json
from .output import note, print_json, print_table, say, weights_in_words

if TYPE_CHECKING:
    from ..search.answers import Answer, Answers


def print_answer(
    answer: Answer,
    verbose: bool,
    as_json: bool,
    of: Answers | None = None,
    exists: bool = False,
) -> None:
    """Prints the candidates of a query, the confidence, and the pose of the first; with
    ``verbose`` and in JSON the scores too, in JSON all poses and, of several answers, the steps for
    its sequence. ``exists``: it has candidates, which are refused if the answer has none."""
    if as_json:
        facts = answer.as_json()
        if of:
            estimate, sequence = estimate_in_json(of.estimate), sequence_of(answer.query)
            steps = {
                step: {n: each[n] for n in [sequence] if n in each}
                if isinstance(each, dict)
                else each
                for step, each in of.recognised.used.items()
            }
            facts |= {"temporal": of.temporal, "steps": steps, "estimate": estimate}
        print_json(facts)
        return
    frames = [f"{c.frame} {c.score:.4f}" if verbose else c.frame for c in answer.candidates]
    words = [answer.score_is] if verbose else []
    words += [f"confidence {answer.confidence:.2f}"]
    if answer.candidates and not math.isnan((pose := answer.candidates[0].pose).x):
        words += [f"x {pose.x:.1f} m, y {pose.y:.1f} m"]
        if not math.isnan(pose.heading):
            words += [f"heading {math.degrees(pose.heading):.0f} degrees"]
    nothing = "refused" if exists else "no candidate"
    say(f"{answer.query}: {', '.join(frames) or nothing} ({', '.join(words)})")


def place_in_json(answer: Answer, of: Answers) -> dict[str, Any]:
    """The best candidate of a picture, for JSON."""
    place = answer.candidates[0] if answer.candidates else None
    return {
        "picture": answer.query,
        "place": place and place.frame,
        "score": place and place.score,
        "score_is": answer.score_is,
        "confidence": answer.confidence,
        "estimate": estimate_in_json(of.estimate),
        **(answer.as_json()["poses"][0] if place else dict.fromkeys(Pose._fields)),
    }


def print_estimate(answers: Answers, verbose: bool) -> None:
    """Prints how many answers are wrong, and how they were found, on stderr."""
    used = answers.recognised.used
    estimated, matched = estimate_in_words(answers.estimate), matched_in_words(used)
    cameras = used.get("camera", {}).values()
    notes = [f"{estimated}. {matched}; {_DETAILS[verbose]}"]
    if any(camera["other_view"] for camera in cameras):
        notes.append(
            "the field of view of the queries seems to differ from that of the map; answers may be "
            "some frames ahead or behind"
        )
    if verbose:
        notes.append(steps_in_words(used, answers.temporal))
    for line in notes:
        note(line)


_DETAILS = {False: "details with --verbose", True: "details below"}


def print_metrics(metrics: Mapping[str, Any], verbose: bool) -> None:
    """Prints all metrics of `measure` with their intervals, and thresholds to choose from."""
    figures = [(name, fraction(one), fraction(*ends)) for name, one, ends in figure_rows(metrics)]
    print_table(("metric", metrics["convention"], "95 % interval"), figures)
    rows: list[tuple[object, ...]] = []
    for name, point in operating_rows(metrics["thresholds"]):
        if point is None:
            rows.append((name, "none"))
            continue
        fractions = (fraction(point[key]) for key in ("precision", "precision_low", "recall"))
        rows.append((name, f"{point['threshold']:.4g}", *fractions, point["accepted"]))
    print_table(
        (
            "threshold for",
            metrics["threshold_is"],
            "precision",
            "lower bound",
            "recall",
            "accepted",
        ),
        rows,
    )
    say(suggestion(metrics))
    for line in without_truth(metrics):
        say(line)
    say(f"{counts(metrics)}; {_DETAILS[verbose]}")
    if verbose:
        say(steps_in_words(metrics["steps"], metrics["temporal"]))
        say(missing_for_sure())


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
    notes += [f"{suggestion(metrics)}. {missing_for_sure()}.", *without_truth(metrics)]
    title = f"{names} against {Path(database).name or database}"
    write_report(path, render(evaluation, title, settings, notes))


def counts(metrics: Mapping[str, Any]) -> str:
    """The number of queries and references, and how they were matched, in a line."""
    steps = metrics.get("steps")
    matched = matched_in_words(steps).lower() if steps else "single frames"
    return (
        f"{metrics['queries']} queries ({metrics['queries_with_match']} with a true match) against "
        f"{metrics['references']} references, {matched}, fingerprint {metrics['fingerprint']}"
    )


def suggestion(metrics: Mapping[str, Any]) -> str:
    """The suggested threshold, and what it accepts."""
    point, kind = metrics["thresholds"]["suggested"], metrics["threshold_is"]
    if point is None:
        return "Suggested threshold: none, no query was recognised"
    of = "" if kind == "confidence" else f" of the {kind}"
    return f"Suggested threshold{of} {threshold_in_words(point, metrics['queries'])}"


def threshold_in_words(point: Mapping[str, Any], count: int) -> str:
    """A threshold for so many candidates, and what it accepts."""
    accepted, right = point["accepted"], round(point["precision"] * point["accepted"])
    wrong = "none" if right == accepted else accepted - right
    return (
        f"{point['threshold']:.4g}: {accepted} of {count} accepted, {wrong} wrong "
        f"(precision at least {100 * point['precision_low']:.0f} %)"
    )


def missing_for_sure() -> str:
    """How the suggested threshold is chosen."""
    return (
        f"The suggested threshold is the lowest whose precision is at least {SURE_PRECISION:.0%} "
        f"with 95 % confidence, which needs {queries_needed()} accepted queries without a mistake, "
        "or else the one whose precision has the highest lower bound. As neighbouring queries are "
        "alike, it is optimistic"
    )


def without_truth(metrics: Mapping[str, Any]) -> Iterator[str]:
    """The estimates for the accepted answers, beside the truth; nothing for other methods."""
    for name, stored in metrics.get("estimates", {}).items():
        truth, judged = stored["truly_wrong"], stored["of_known_truth"]
        of = f" of {judged} whose truth is known" if judged != stored["accepted"] else ""
        true = "" if truth is None else f"; in truth {round(truth * judged)} wrong{of}"
        estimate = Estimate(*(stored[field] for field in Estimate._fields))
        suggested = "" if name == "accepted" else ", at most 5 % wrong"
        yield f"Without ground truth{suggested}: {estimate_in_words(estimate)}{true}"


def estimate_in_words(estimate: Estimate) -> str:
    """How many answers are accepted, and how many of them are wrong without ground truth."""
    count = estimate.accepted
    if not count:
        return "no answer is accepted"
    answers = f"{count} answer{'s' * (count != 1)}"
    if estimate.confidence:
        answers += f" of confidence {estimate.confidence:.2f} and more"
    if estimate.low is None or estimate.high is None:
        few = "too few or too unclear" if estimate.wrong < 1 else "too few map frames"
        return f"{answers}, {few} to say how many are wrong"
    low, high = round(count * estimate.low), round(count * estimate.high)
    return f"{answers}, about {round(count * estimate.wrong)} wrong ({low} to {high})"


def matched_in_words(used: Mapping[str, Any]) -> str:
    """Which sequences were matched as such."""
    sequences = len(used["follow"])
    followed = sum(not words.startswith("no") for words in used["follow"].values())
    if not followed:
        return "Matched as single frames"
    if followed < sequences:
        return f"Matched {followed} of {sequences} sequences, the others as single frames"
    return f"Matched as {'one sequence' if sequences == 1 else f'{sequences} sequences'}"


def steps_in_words(used: Mapping[str, Any], temporal: int | None = None) -> str:
    """The steps between descriptors and a decision, in a line; those of Eq. 3 only if given."""
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
    if cameras := {name: str(Camera(**of)) for name, of in used.get("camera", {}).items()}:
        words.append(f"camera {by_sequence(cameras)}")
    if used["delay"]:
        words.append(f"answers wait for {used['delay']} queries")
    if temporal is not None:
        words.append(f"temporal sum t = {temporal}" if temporal else "no temporal sum")
    if used["references"] < MIN_FRAMES:
        words.append(f"no confidence: {used['references']} references are too few")
    return ", ".join(words)


def by_sequence(values: Mapping[str, str]) -> str:
    """What holds for each sequence; the names of the sequences only where they differ."""
    names: dict[str, list[str]] = {}
    for name, value in values.items():
        names.setdefault(value, []).append(name)
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{value} ({shortened(of, most=3)})" for value, of in names.items())
