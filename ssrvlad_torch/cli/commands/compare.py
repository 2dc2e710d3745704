"""``ssrvlad compare``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...baselines import METHODS
from ...evaluation.metrics import fraction
from ...files import parse_yaml
from ..options import Json, StepOptions, TruthOptions, argument, option
from ..output import finish, note, print_json, print_table, progress_bar, say

if TYPE_CHECKING:
    from ...baselines import Method
    from ...baselines.comparison import Row

AT = ("1", "5", "10")

_METHOD = (
    f"Methods to compare, separated by commas: {', '.join(METHODS)}, or FILE.h5, the descriptors "
    "of any other method as hloc stores them."
)


def compare(
    *,
    dataset: Path | None = argument(
        "Folder of a data set. Without it, --references and --queries are folders.", default=None
    ),
    references: list[str] | None = option(
        "Sequence of the data set to use as references; * stands for any text; can be repeated. "
        "Default: the references that the data set declares."
    ),
    queries: list[str] | None = option(
        "Sequence of the data set to use as queries, in the same form. Default: the queries that "
        "the data set declares."
    ),
    layout: str | None = option(
        "Layout of the data set, see ssrvlad encode. Default: auto (recognised)."
    ),
    labels: Path | None = option("Folder of label maps to use instead of those of the data set."),
    labels_as: str | None = option(
        "Label space of the label maps: a name or a .yaml file. Default: the one of the data set. "
        "Without both, PNG files that could be images or label maps are read as images."
    ),
    truth: TruthOptions,
    steps: StepOptions,
    method: str = option(_METHOD, default=...),
    settings: list[str] | None = option(
        "Setting of a method, METHOD.NAME=VALUE, such as netvlad.weights=FILE; can be repeated.",
        "--set",
    ),
    workers: int = option("Threads that read ahead.", default=2, min=1),
    as_json: Json = False,
) -> None:
    """Compare methods on one data set: metrics with 95 % bootstrap intervals over blocks of
    neighbouring queries, and costs. Each method is measured twice: by the scores of single
    frames, and with the steps below. --standardise needs descriptors that are vectors or signs,
    --sweep needs ssr-vlad or features. Methods without their images, label maps or weights are
    left out. The others are compared on the frames that all of them can use.

    Example: ssrvlad compare town --method ssr-vlad,cohog --labels-as camvid-11

    \b
    Example: ssrvlad compare --references photos/monday --queries photos/today \\
    --method hog,cohog --tolerance-frames 1
    """
    from ...baselines.comparison import ComparisonSettings
    from ...baselines.comparison import compare as compared
    from ...datasets.dataset import GroundTruth
    from ...datasets.sides import open_sides
    from ...encoding.results import Skipped

    methods = _make([name.strip() for name in method.split(",")], settings or ())
    sides = open_sides(
        note, dataset=dataset, references=references, queries=queries, layout=layout, labels=labels,
        labels_as=labels_as,
    )  # fmt: skip
    true = GroundTruth.chosen(sides.truth, *truth.definition)
    how = ComparisonSettings(true, truth.convention, steps.steps(), workers, progress_bar)
    rows = compared(methods, sides, how, note)
    if as_json:
        print_json({"rows": rows})
    else:
        _print(rows)
    finish([Skipped(row["method"], row["reason"]) for row in rows if "reason" in row])


def _make(names: Sequence[str], pairs: Sequence[str]) -> dict[str, Method | str]:
    """The methods by name, with the settings of ``METHOD.NAME=VALUE`` pairs, whose values are read
    as YAML; for a method that cannot be made, the reason."""
    from ...baselines import make

    settings: dict[str, dict[str, Any]] = {name: {} for name in names}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        name, dot, setting = key.partition(".")
        if not equals:
            raise ValueError(f"--set: expected NAME=VALUE, got {pair!r}")
        if not dot or name not in settings:
            raise ValueError(
                f"--set: expected METHOD.NAME=VALUE for one of {', '.join(names)}, got {key!r}"
            )
        settings[name][setting] = parse_yaml(value, f"the value of --set {key}")
    methods: dict[str, Method | str] = {}
    for name, values in settings.items():
        try:
            methods[name] = make(name, **values)
        except TypeError as error:
            text = ", ".join(f"{key}={value!r}" for key, value in values.items())
            raise ValueError(f"method {name} cannot take {text}: {error}") from error
        except (OSError, ImportError) as error:
            methods[name] = str(error)
    return methods


def _print(rows: Sequence[Row]) -> None:
    from ..summaries import steps_in_words

    done = [row for row in rows if "reason" not in row]
    rates = (f"RecallRate\n@{n}" for n in AT)
    print_table(("method", *rates, "AUC-PR", "Recall@100%\nPrecision"), map(_quality, rows))
    if not done:
        return
    head = ("method", "bytes a reference", "encode\nms a query", "match\nms a query")
    print_table(head, (_costs(row) for row in done if not row["steps"]))
    say(
        f"{done[0]['queries']} queries ({done[0]['queries_with_match']} with a true match) against "
        f"{done[0]['references']} references, convention {done[0]['convention']}; in each cell the "
        "95 % interval; times are of single frames, with the least and the greatest"
    )
    for row in done:
        if row["steps"]:
            say(f"{row['method']} with steps: {steps_in_words(row['steps'], row['temporal'])}")


def _costs(row: Row) -> list[str]:
    times = (
        f"{cost['average']:.2f}\n{cost['min']:.2f}-{cost['max']:.2f}"
        for cost in (row["encode_ms"], row["match_ms"])
    )
    return [row["method"], f"{row['bytes_a_reference']:.0f}", *times]


def _quality(row: Row) -> list[str]:
    if "reason" in row:
        return [row["method"], "not run"]
    steps = "\n  with steps" if row["steps"] else ""
    names, ends = ("auc_pr", "recall_at_100_precision"), row["intervals"]
    pairs = [(row["recall_at"][n], ends["recall_at"][n]) for n in AT]
    pairs += [(row[name], ends[name]) for name in names]
    figures = (
        fraction(value) + ("" if math.isnan(value) else f"\n{low:.2f}-{high:.2f}")
        for value, (low, high) in pairs
    )
    return [row["method"] + steps, *figures]
