"""``ssrvlad compare``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from ...baselines import METHODS
from ..options import DriveOptions, Json, RandomWeights, StepOptions, TruthOptions, Workers, option
from ..output import figure, finish, print_json, print_table, say

if TYPE_CHECKING:
    from ...baselines import Method
    from ...evaluation.metrics import Convention
    from ...recognition.recognise import Steps
    from ..drives import Drives
    from ..truth import TrueMatches

Row = dict[str, Any]
"""The figures and costs of a method, or its name and the reason why it could not run."""


class How(NamedTuple):
    """How methods are measured; ``together`` are those whose scores are fused."""

    true: TrueMatches
    convention: Convention
    steps: Steps
    workers: int
    together: Sequence[str]


AT_RECALL = 0.5
AT = ("1", "5", "10")
COSTS = ("encode", "match")
_TOGETHER = "--fuse"


def compare(
    *,
    given: DriveOptions,
    truth: TruthOptions,
    steps: StepOptions,
    method: str = option(..., f"Methods, with commas between: {', '.join(METHODS)}."),
    settings: list[str] | None = option(
        None, "A setting, METHOD.NAME=VALUE, such as netvlad.weights=FILE; repeatable.", "--set"
    ),
    fuse: str | None = option(
        None, "Some of the methods, with commas between, whose scores are also taken together."
    ),
    random_weights: RandomWeights = False,
    workers: Workers = 2,
    as_json: Json = False,
) -> None:
    """Compare methods on one data set: how well they recognise, with 95 % bootstrap intervals, and
    what they cost. Each method is measured twice: by the scores of single frames, and with the
    steps below. --standardise needs descriptors that are vectors, and --sweep needs ssr-vlad.
    Methods that lack images, label maps or weights are left out. The others are compared on the
    frames that all of them can use. --fuse adds up the scores of methods,
    each weighted by how far its first candidates are ahead on the queries at hand.

    Example: ssrvlad compare town --method ssr-vlad,cohog --labels-as camvid-11

    \b
    Example: ssrvlad compare town --method ssr-vlad,hog --fuse ssr-vlad,hog --labels-as camvid-11

    \b
    Example: ssrvlad compare --references photos/monday --queries photos/today \\
    --method hog,cohog --tolerance-frames 1
    """
    from ...encoding.results import Skipped
    from ..drives import Drives
    from ..recognise import parse_settings, steps_of
    from ..truth import TrueMatches

    names = [name.strip() for name in method.split(",")]
    together = [name.strip() for name in fuse.split(",")] if fuse else []
    if fuse and (len(set(together)) < 2 or not set(together) <= set(names)):
        raise ValueError(f"--fuse: expected two or more of {', '.join(names)}, got {fuse!r}")
    methods = _make(names, parse_settings(settings or ()), random_weights)
    drives = Drives.open(given)
    true = TrueMatches.by(truth, drives.whole.truth)
    if true.metres is not None:
        drives = drives.posed()
    how = How(true, truth.convention, steps_of(steps), workers, together)
    rows = _rows(methods, drives, how)
    if as_json:
        print_json({"rows": rows})
    else:
        _print(rows)
    finish([Skipped(row["method"], row["reason"]) for row in rows if "reason" in row])


def _make(
    names: Sequence[str], settings: Mapping[str, Any], random_weights: bool
) -> dict[str, Method | str]:
    """The methods by name, or in place of one the reason why it cannot be made."""
    from ..recognise import make, takes

    own: dict[str, dict[str, Any]] = {name: {} for name in names}
    for key, value in settings.items():
        name, dot, setting = key.partition(".")
        if not dot or name not in own:
            expected = ", ".join(own)
            raise ValueError(f"--set wants METHOD.NAME=VALUE for one of {expected}, got {key!r}")
        own[name][setting] = value
    methods: dict[str, Method | str] = {}
    for name, given in own.items():
        free = {"random_weights": True} if random_weights and takes(name, "random_weights") else {}
        try:
            methods[name] = make(name, {**free, **given})
        except (OSError, ImportError) as error:
            methods[name] = str(error)
    return methods


def _rows(methods: Mapping[str, Method | str], drives: Drives, how: How) -> list[Row]:
    """The rows of all methods in their order, and at the end those of the fused ones."""
    from ..drives import KINDS

    lacking = {kind: reason for kind in KINDS if (reason := drives.lacks(kind))}
    rows: dict[str, list[Row]] = {}
    able: dict[str, Method] = {}
    for name, method in methods.items():
        if isinstance(method, str):
            rows[name] = [_not_run(name, method)]
        elif reasons := [lacking[need] for need in sorted(method.needs) if need in lacking]:
            rows[name] = [_not_run(method.name, reasons[0])]
        else:
            able[name] = method
    if able:
        needs = {need for method in able.values() for need in method.needs}
        drives = drives.complete([kind for kind in KINDS if kind in needs])
        rows |= _run(able, drives, how)
    if how.together and _TOGETHER not in rows:
        missing = next(name for name in how.together if "reason" in rows[name][0])
        rows[_TOGETHER] = [_not_run(" + ".join(how.together), f"{missing} does not run")]
    order = [*methods, _TOGETHER] if how.together else methods
    return [row for name in order for row in rows[name]]


def _run(methods: Mapping[str, Method], drives: Drives, how: How) -> dict[str, list[Row]]:
    """The rows of each method: of single frames, and with the steps."""
    from ...recognition.recognise import AS_PAPER
    from ..fused import followed, fused
    from ..measure import Recognition, measure, wants_similarity
    from ..recognise import recognise
    from ..truth import Places

    true, convention, steps, workers, together = how
    parts, whole, rows = (drives.references, drives.queries), drives.whole, dict[str, list[Row]]()
    matches = true.among(*(Places.of(part.frames, whole) for part in parts))
    taken = None if wants_similarity(convention) or steps == AS_PAPER else steps
    singly = replace(steps, follow=None, delay=0)
    members: dict[str, Recognition] = {}

    def measured(found: Sequence[Recognition]) -> list[Row]:
        return [measure(each, matches, convention, AT_RECALL) for each in found]

    for name, method in methods.items():
        labelled = "labels" in method.needs
        there, here = (part.label_files() if labelled else part.image_files() for part in parts)
        labels_as = whole.labels_as if labelled else None
        all_pairs = wants_similarity(convention) or name in together
        own = singly if taken and name in together else taken
        try:
            found = recognise(method, there, here, labels_as, workers, all_pairs, own)
        except ValueError as error:
            rows[name] = [_not_run(method.name, str(error))]
            continue
        if name in together:
            members[name] = found[-1]
            found = [found[0], *(followed(each, steps) for each in found[1:])]
        rows[name] = measured(found)
    if together and set(together) <= set(members):
        chosen = [members[name] for name in together]
        rows[_TOGETHER] = measured(fused(chosen, taken or singly))
    return rows


def _not_run(method: str, reason: str) -> Row:
    return {"method": method, "reason": reason}


def _print(rows: Sequence[Row]) -> None:
    """Two tables, of the figures and of the costs, a row a method in both."""
    from rich.table import Table

    from ..measure import steps_in_words

    done = [row for row in rows if "reason" not in row]
    quality = Table(
        "method", *(f"RecallRate\n@{n}" for n in AT), "AUC-PR", "Recall@100%\nPrecision"
    )
    for row in rows:
        alone = "weights" in row and set(row["steps"]["follow"].values()) == {"no"}
        steps = "\n  with steps" if row.get("steps") and not alone else ""
        name = row["method"] + steps
        quality.add_row(name, *(_figures(row) if row in done else ["not run"]))
    print_table(quality)
    if not done:
        return
    costs = Table("method", "bytes a reference", *(f"{what}\nms a query" for what in COSTS))
    for row in done:
        if not row["steps"]:
            times = (_times(row[f"{what}_ms"]) for what in COSTS)
            costs.add_row(row["method"], f"{row['bytes_a_reference']:.0f}", *times)
    print_table(costs)
    say(
        f"{done[0]['queries']} queries ({done[0]['queries_with_match']} with a true match) against "
        f"{done[0]['references']} references, convention {done[0]['convention']}; in each cell the "
        "95 % interval, and of times, which are of single frames, the least and the most"
    )
    for row in done:
        if row["steps"]:
            say(f"{row['method']} with steps: {steps_in_words(row['steps'], row['temporal'])}")


def _figures(row: Row) -> list[str]:
    names, ends = ("auc_pr", "recall_at_100_precision"), row["intervals"]
    figures = [(row["recall_at"][n], ends["recall_at"][n]) for n in AT]
    return [_cell(*pair) for pair in (*figures, *((row[name], ends[name]) for name in names))]


def _cell(value: float, ends: Sequence[float]) -> str:
    return figure(value) + ("" if math.isnan(value) else f"\n{ends[0]:.2f}-{ends[1]:.2f}")


def _times(cost: Mapping[str, float]) -> str:
    return f"{cost['average']:.2f}\n{cost['min']:.2f}-{cost['max']:.2f}"
