"""``ssrvlad compare``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from ...baselines import METHODS
from ..options import DriveOptions, Json, RandomWeights, StepOptions, TruthOptions, Workers, option
from ..output import finish, fraction, print_json, print_table, say

if TYPE_CHECKING:
    from ...baselines import Method
    from ...evaluation.metrics import Convention
    from ...recognition.recognise import Steps
    from ..drives import Drives
    from ..truth import TrueMatches

Row = dict[str, Any]
"""The metrics and costs of a method, or its name and the reason why it could not run."""


class Protocol(NamedTuple):
    """How methods are measured; ``fused`` are those whose scores are fused."""

    true: TrueMatches
    convention: Convention
    steps: Steps
    workers: int
    fused: Sequence[str]


AT_RECALL = 0.5
AT = ("1", "5", "10")
COSTS = ("encode", "match")
_FUSED = "--fuse"


def compare(
    *,
    options: DriveOptions,
    truth: TruthOptions,
    steps: StepOptions,
    method: str = option(
        f"Methods to compare, separated by commas: {', '.join(METHODS)}.", default=...
    ),
    settings: list[str] | None = option(
        "Setting of a method, METHOD.NAME=VALUE, such as netvlad.weights=FILE; can be repeated.",
        "--set",
    ),
    fuse: str | None = option(
        "Methods whose scores are also fused, two or more of --method, separated by commas."
    ),
    random_weights: RandomWeights = False,
    workers: Workers = 2,
    as_json: Json = False,
) -> None:
    """Compare methods on one data set: metrics with 95 % bootstrap intervals, and costs. Each
    method is measured twice: by the scores of single frames, and with the steps below.
    --standardise needs descriptors that are vectors, and --sweep needs ssr-vlad. Methods without
    their images, label maps or weights are left out. The others are compared on the frames that
    all of them can use. --fuse adds the scores of methods; features count more than HOG, HOG more
    than label maps, and each the more, the farther its first candidates are ahead.

    Example: ssrvlad compare town --method ssr-vlad,cohog --labels-as camvid-11

    \b
    Example: ssrvlad compare town --method ssr-vlad,hog --fuse ssr-vlad,hog --labels-as camvid-11

    \b
    Example: ssrvlad compare --references photos/monday --queries photos/today \\
    --method hog,cohog --tolerance-frames 1
    """
    from ...encoding.results import Skipped
    from ..drives import Drives
    from ..methods import parse_settings
    from ..search import steps_of
    from ..truth import TrueMatches

    names = [name.strip() for name in method.split(",")]
    fused = [name.strip() for name in fuse.split(",")] if fuse else []
    if fuse and (len(set(fused)) < max(2, len(fused)) or not set(fused) <= set(names)):
        raise ValueError(f"--fuse: expected two or more of {', '.join(names)}, got {fuse!r}")
    methods = _make(names, parse_settings(settings or ()), random_weights)
    drives = Drives.open(options)
    true = TrueMatches.of(truth, drives.whole.truth)
    if true.metres is not None:
        drives = drives.posed()
    protocol = Protocol(true, truth.convention, steps_of(steps), workers, fused)
    rows = _rows(methods, drives, protocol)
    if as_json:
        print_json({"rows": rows})
    else:
        _print(rows)
    finish([Skipped(row["method"], row["reason"]) for row in rows if "reason" in row])


def _make(
    names: Sequence[str], settings: Mapping[str, Any], random_weights: bool
) -> dict[str, Method | str]:
    """The methods by name; for a method that cannot be made, the reason."""
    from ..methods import has_setting, make

    by_method: dict[str, dict[str, Any]] = {name: {} for name in names}
    for name, values in by_method.items():
        if random_weights and has_setting(name, "random_weights"):
            values["random_weights"] = True
    for key, value in settings.items():
        name, dot, setting = key.partition(".")
        if not dot or name not in by_method:
            raise ValueError(
                f"--set: expected METHOD.NAME=VALUE for one of {', '.join(names)}, got {key!r}"
            )
        by_method[name][setting] = value
    methods: dict[str, Method | str] = {}
    for name, values in by_method.items():
        try:
            methods[name] = make(name, values)
        except (OSError, ImportError) as error:
            methods[name] = str(error)
    return methods


def _rows(methods: Mapping[str, Method | str], drives: Drives, protocol: Protocol) -> list[Row]:
    """The rows of all methods in their order, then the rows of the fused methods."""
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
        rows |= _run(able, drives, protocol)
    if protocol.fused and _FUSED not in rows:
        missing = next(name for name in protocol.fused if "reason" in rows[name][0])
        rows[_FUSED] = [_not_run(" + ".join(protocol.fused), f"{missing} does not run")]
    order = [*methods, _FUSED] if protocol.fused else methods
    return [row for name in order for row in rows[name]]


def _run(methods: Mapping[str, Method], drives: Drives, protocol: Protocol) -> dict[str, list[Row]]:
    """The rows of each method: of single frames, and with the steps."""
    from ...recognition.recognise import AS_PAPER
    from ..fused import followed, fused
    from ..measure import Recognition, measure, needs_similarity
    from ..methods import run_method
    from ..truth import Places

    true, convention, steps, workers, to_fuse = protocol
    parts, whole, rows = (drives.references, drives.queries), drives.whole, dict[str, list[Row]]()
    truth = true.among(*(Places.of(part.frames, whole) for part in parts))
    all_steps = None if needs_similarity(convention) or steps == AS_PAPER else steps
    no_following = replace(steps, follow=None, delay=0)
    members: dict[str, Recognition] = {}

    def measured(found: Sequence[Recognition]) -> list[Row]:
        return [measure(each, truth, convention, AT_RECALL) for each in found]

    for name, method in methods.items():
        labelled = "labels" in method.needs
        references, queries = (
            part.label_files() if labelled else part.image_files() for part in parts
        )
        labels_as = whole.labels_as if labelled else None
        all_pairs = needs_similarity(convention) or name in to_fuse
        method_steps = no_following if all_steps and name in to_fuse else all_steps
        try:
            found = run_method(
                method, references, queries, labels_as, workers, all_pairs, method_steps
            )
        except ValueError as error:
            rows[name] = [_not_run(method.name, str(error))]
            continue
        if name in to_fuse:
            members[name] = found[-1]
            found = [found[0], *(followed(each, steps) for each in found[1:])]
        rows[name] = measured(found)
    if to_fuse and set(to_fuse) <= set(members):
        chosen = [members[name] for name in to_fuse]
        rows[_FUSED] = measured(fused(chosen, all_steps or no_following))
    return rows


def _not_run(method: str, reason: str) -> Row:
    return {"method": method, "reason": reason}


def _print(rows: Sequence[Row]) -> None:
    """Prints two tables, of the metrics and of the costs, with a row for each method."""
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
        quality.add_row(name, *(_metrics(row) if row in done else ["not run"]))
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
        "95 % interval; times are of single frames, with the least and the greatest"
    )
    for row in done:
        if row["steps"]:
            say(f"{row['method']} with steps: {steps_in_words(row['steps'], row['temporal'])}")


def _metrics(row: Row) -> list[str]:
    names, ends = ("auc_pr", "recall_at_100_precision"), row["intervals"]
    recalls = [(row["recall_at"][n], ends["recall_at"][n]) for n in AT]
    return [_cell(*pair) for pair in (*recalls, *((row[name], ends[name]) for name in names))]


def _cell(value: float, ends: Sequence[float]) -> str:
    return fraction(value) + ("" if math.isnan(value) else f"\n{ends[0]:.2f}-{ends[1]:.2f}")


def _times(cost: Mapping[str, float]) -> str:
    return f"{cost['average']:.2f}\n{cost['min']:.2f}-{cost['max']:.2f}"
