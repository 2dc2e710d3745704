"""The command line: ``ssrvlad COMMAND``. Results go to stdout, errors are one line on stderr.

Exit codes: 0 success, 2 wrong use or an input that nothing can be done with, 3 finished with some
inputs refused.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from .bench import bench_this_machine
from .config import SSRVLADConfig
from .database import Database, FrameSet, natural_key
from .datasets.dataset import Dataset, Role
from .datasets.frame_files import FrameFile
from .datasets.image_files import find_image_files
from .datasets.label_files import find_label_files, read_label_map
from .datasets.layouts import open_dataset
from .datasets.synthetic_city import write_city
from .demo import STEPS, run_demo
from .descriptor import SSRVLAD
from .encoding import Refusal, encode_to_database, encode_to_memory
from .evaluation.ground_truth import from_frame_numbers, from_poses
from .evaluation.ground_truth_files import Known, from_file, of_known
from .evaluation.metrics import Convention, precision_recall_curve
from .evaluation.metrics import evaluate as measure
from .evaluation.outcomes import judge
from .evaluation.thresholds import operating_points
from .matching import match
from .segmentation import Segmenter
from .show import draw

WRONG_USE = 2
SOME_REFUSED = 3
INTERRUPTED = 130
RESAMPLES = 1000

FIGURES = {
    "auc_pr": "AUC-PR",
    "average_precision": "average precision",
    "recall_at_100_precision": "Recall@100%Precision",
    "extended_precision": "extended precision",
    "roc_auc": "ROC-AUC",
}

app = typer.Typer(
    name="ssrvlad",
    help="Place recognition from semantic segmentation (SSR-VLAD).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
database_app = typer.Typer(help="Look into a database.", rich_markup_mode=None)
app.add_typer(database_app, name="db")

Source = Annotated[
    list[str],
    typer.Argument(
        help="Folders, globs or files of label maps, or of images with --segmenter; a folder is a "
        "sequence."
    ),
]
DatabaseFolder = Annotated[Path, typer.Argument(help="Folder of the database.")]
LabelsAs = Annotated[str, typer.Option(help="Label space of the ids: a name or a .yaml file.")]
MaybeLabelsAs = Annotated[
    str | None,
    typer.Option("--labels-as", help="Label space of the ids; the database's if not given."),
]
Temporal = Annotated[
    int, typer.Option(min=0, help="t of Eq. 3: reference frames summed on each side.")
]
SequenceName = Annotated[
    str | None, typer.Option("--sequence", help="Name of the sequence; the folder's if not given.")
]
Every = Annotated[int, typer.Option(min=1, help="Take every so many-th frame of a sequence.")]
Start = Annotated[int, typer.Option(min=0, help="First frame that is taken of a sequence.")]
SegmenterFile = Annotated[
    Path | None,
    typer.Option(
        "--segmenter",
        help="Network that labels images: an .onnx file, or a .yaml file with network: FILE.onnx "
        "and its settings.",
    ),
]
SegmenterCache = Annotated[
    Path | None,
    typer.Option(help="Folder that keeps what the segmenter made; ~/.cache/ssrvlad if not given."),
]
LayoutName = Annotated[
    str | None,
    typer.Option(
        "--layout",
        help="SOURCE is the folder of a data set: auto, or extended-cmu, robotcar-seasons, "
        "synthia, cityscapes, camvid, vpr-bench, folders.",
    ),
]
Split = Annotated[
    list[str] | None,
    typer.Option("--split", help="With --layout: a sequence to take, * for any text; repeatable."),
]
RoleName = Annotated[
    Role | None, typer.Option("--role", help="With --layout: what the data set means for this.")
]
LabelsFolder = Annotated[
    Path | None,
    typer.Option("--labels", help="With --layout: other label maps than the data set's own."),
]
Workers = Annotated[int, typer.Option(min=1, help="Threads that read ahead.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Frames = Annotated[int, typer.Option(min=2, help="Frames of each traverse.")]
Seed = Annotated[int, typer.Option(min=0, help="Another seed is another city.")]


def main() -> None:
    """Entry point: runs the command line; an error becomes one line and an exit code."""
    try:
        code = app(standalone_mode=False)
    except typer.TyperException as error:
        code = _complain(error.format_message())
    except (ValueError, OSError, ImportError) as error:
        code = _complain(str(error))
    except (typer.Abort, KeyboardInterrupt):
        _complain("interrupted")
        code = INTERRUPTED
    sys.exit(code)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for all that it writes.")] = Path(
        "ssrvlad-demo"
    ),
    frames: Frames = 100,
    seed: Seed = 0,
) -> None:
    """The main job on generated data: drive twice through a synthetic city, encode, match,
    evaluate, picture.

    Example: ssrvlad demo --out /tmp/ssrvlad-demo
    """

    with _progress("demo", STEPS * frames) as advance:
        result = run_demo(out, frames, seed, advance)
    _print_metrics(result.metrics)
    print(f"picture: {result.picture}")


@app.command()
def city(
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    frames: Frames = 100,
    seed: Seed = 0,
) -> None:
    """Write the synthetic city: reference/ and query/ label PNGs (cityscapes-trainids), poses.csv
    and ground_truth.json.

    Example: ssrvlad city /tmp/city --frames 200 --seed 7
    """

    with _progress("rendering", 2 * frames) as advance:
        write_city(out, frames=frames, seed=seed, progress=advance)
    print(f"{out}: {frames} reference and {frames} query frames")


@app.command()
def encode(
    source: Source,
    output: Annotated[Path, typer.Option("--output", "-o", help="Database: new, or added to.")],
    labels_as: Annotated[
        str | None,
        typer.Option(
            help="Label space of the ids: a name or a .yaml file; the data set's with --layout."
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="paper or default; if not given the database's, or default."),
    ] = None,
    layout: LayoutName = None,
    split: Split = None,
    role: RoleName = None,
    labels: LabelsFolder = None,
    sequence: SequenceName = None,
    every: Every = 1,
    start: Start = 0,
    segmenter: SegmenterFile = None,
    segmenter_cache: SegmenterCache = None,
    workers: Workers = 2,
    as_json: Json = False,
) -> None:
    """Encode label maps, or images with a segmenter, into a database. Run again, it adds only
    what is missing.

    Example: ssrvlad encode maps/monday maps/tuesday -o town.ssrdb --labels-as camvid-11
    """

    dataset = _dataset(source, layout, split, role, labels, labels_as)
    labels_as = labels_as or (dataset.labels_as if dataset else None)
    if labels_as is None:
        raise ValueError("Missing option '--labels-as': what the ids of the label maps mean")
    if preset is None and Database.exists(output):
        config = dataclasses.replace(Database.open(output).config, labels_as=labels_as)
    else:
        config = SSRVLADConfig.from_preset(preset or "default", labels_as=labels_as)
    head = SSRVLAD(config)
    selection, segmenting = (sequence, every, start), (segmenter, segmenter_cache)
    files, labeller = _find(source, selection, segmenting, labels_as, dataset)
    database = Database.open_or_create(output, config)
    with _progress("encoding", len(files)) as advance:
        summary = encode_to_database(head, files, database, workers, advance, labeller)
    if as_json:
        counts = dataclasses.asdict(summary)
        refused = [refusal._asdict() for refusal in summary.refused]
        _print_json({"database": str(output), **counts, "refused": refused, **_info(output)})
    else:
        print(
            f"{output}: {summary.encoded} frames encoded ({summary.empty} of them empty), "
            f"{summary.already_there} already there, {len(summary.refused)} refused"
        )
    _finish(summary.refused)


@app.command()
def query(
    database: DatabaseFolder,
    source: Source,
    labels_as: MaybeLabelsAs = None,
    top: Annotated[int, typer.Option(min=1, help="Candidates of each query.")] = 5,
    threshold: Annotated[
        float | None, typer.Option(help="Leave out candidates whose score is not above it.")
    ] = None,
    temporal: Temporal = 3,
    layout: LayoutName = None,
    split: Split = None,
    role: RoleName = None,
    labels: LabelsFolder = None,
    sequence: SequenceName = None,
    every: Every = 1,
    start: Start = 0,
    segmenter: SegmenterFile = None,
    segmenter_cache: SegmenterCache = None,
    workers: Workers = 2,
    as_json: Json = False,
) -> None:
    """Recognise places: ranked candidate frames with scores for every label map.

    Example: ssrvlad query town.ssrdb maps/today --top 3
    """

    selection, segmenting = (sequence, every, start), (segmenter, segmenter_cache)
    dataset = _dataset(source, layout, split, role, labels, labels_as)
    references, queries, refused = _load(
        database, source, labels_as, temporal, selection, segmenting, workers, dataset
    )
    found = match(queries.descriptors, references.descriptors, top, threshold)
    for frame, scores, rows in zip(queries.frames, *found, strict=True):
        candidates = [
            {"frame": references.frames[row], "score": score}
            for row, score in zip(rows.tolist(), scores.tolist(), strict=True)
            if row >= 0
        ]
        if as_json:
            _print_json({"query": frame, "candidates": candidates})
        else:
            ranked = ", ".join(f"{c['frame']} {c['score']:.4f}" for c in candidates)
            print(f"{frame}: {ranked or 'no candidate'}")
    _finish(refused)


@app.command()
def evaluate(
    database: DatabaseFolder,
    source: Source,
    labels_as: MaybeLabelsAs = None,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            help="Pairs of frame ids (.json, .csv), a 0/1 matrix (.npy, .npz, .csv) or VPR-Bench's "
            "ground_truth_new.npy."
        ),
    ] = None,
    tolerance_metres: Annotated[
        float | None, typer.Option(help="Or: true matches are this near, by poses.csv.")
    ] = None,
    tolerance_degrees: Annotated[
        float | None, typer.Option(help="With --tolerance-metres: and their headings this alike.")
    ] = None,
    tolerance_frames: Annotated[
        int | None, typer.Option(help="Or: true matches are at most so many frames away.")
    ] = None,
    convention: Annotated[Convention, typer.Option(help="Whose way of computing it is.")] = "exact",
    at_recall: Annotated[
        float, typer.Option(min=0, max=1, help="Recall at which the precision is told.")
    ] = 0.5,
    temporal: Temporal = 3,
    layout: LayoutName = None,
    split: Split = None,
    role: RoleName = None,
    labels: LabelsFolder = None,
    sequence: SequenceName = None,
    every: Every = 1,
    start: Start = 0,
    segmenter: SegmenterFile = None,
    segmenter_cache: SegmenterCache = None,
    workers: Workers = 2,
    as_json: Json = False,
) -> None:
    """Measure the recognition: RecallRate@N, AUC-PR, Recall@100%Precision and more, with 95 %
    bootstrap intervals, and what follows from the choice of a threshold. The suggested one is the
    lowest whose precision is at least 0.95 at the lower end of its own 95 % interval.

    Example: ssrvlad evaluate town.ssrdb maps/today --tolerance-metres 5
    """

    dataset = _dataset(source, layout, split, role, labels, labels_as)
    given = (ground_truth, tolerance_metres, tolerance_frames)
    if dataset and dataset.truth and given == (None, None, None):
        _, ground_truth, tolerance_metres, tolerance_frames = dataset.truth
    if dataset and tolerance_metres is not None:
        dataset = dataset.posed()
    tolerance = (tolerance_metres, tolerance_degrees, tolerance_frames)
    _check_tolerance(ground_truth, *tolerance)
    selection, segmenting = (sequence, every, start), (segmenter, segmenter_cache)
    references, queries, refused = _load(
        database, source, labels_as, temporal, selection, segmenting, workers, dataset
    )
    truths = _true_matches(ground_truth, tolerance, queries, references, refused)
    known, truth = of_known(truths)
    unknown = len(truths) - len(known)
    if unknown:
        _note(f"{unknown} of {len(truths)} queries are left out: {ground_truth} does not name them")
    themselves = len(set(queries.frames) & set(references.frames))
    if themselves:
        _note(f"{themselves} of {len(queries.frames)} queries are in the database themselves")
    found = match(queries.descriptors, references.descriptors, top=10)
    scores, rows = (best.numpy()[known] for best in found)
    similarity = None
    if convention.startswith("vpr-tutorial"):
        similarity = _similarity(queries, references)[known]
    metrics = measure(
        scores, rows, truth, convention=convention, similarity=similarity, resamples=RESAMPLES
    )
    curve = precision_recall_curve(judge(scores, rows, truth), truth)
    metrics["thresholds"] = operating_points(curve, [at_recall])
    metrics["references"] = len(references.frames)
    metrics["fingerprint"] = Database.open(database).fingerprint
    if as_json:
        _print_json(metrics)
    else:
        _print_evaluation(metrics)
    _finish(refused)


@app.command()
def show(
    labels: Annotated[Path, typer.Argument(help="A label map.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write.")],
    labels_as: LabelsAs,
    preset: Annotated[str, typer.Option(help="paper or default.")] = "default",
) -> None:
    """Picture what the method sees in one frame: layers, skeletons, key-points, centres,
    histograms.

    Example: ssrvlad show maps/monday/000042.png -o frame.png --labels-as camvid-11
    """

    head = SSRVLAD.from_preset(preset, labels_as=labels_as)
    file = find_label_files([str(labels)])[0]
    draw(read_label_map(file, head.label_space), head, output, title=file.frame)
    print(output)


@app.command()
def bench(
    repetitions: Annotated[int, typer.Option(min=1, help="How often each way is timed.")] = 5,
    as_json: Json = False,
) -> None:
    """Time the method on this machine, one thread: reference, eager, compiled.

    Example: ssrvlad bench --repetitions 3
    """
    rows = bench_this_machine(repetitions)
    if as_json:
        _print_json({"rows": rows})
        return
    columns = ("preset", "batch", "way", "ms an image", "min", "max", "times faster")
    table = Table(*columns)
    for row in rows:
        times = [f"{row[key]:.2f}" for key in ("median_ms", "min_ms", "max_ms")]
        ratio = f"{row['times_faster']:.1f}" if "times_faster" in row else ""
        table.add_row(row["preset"], str(row["batch"]), row["way"], *times, ratio)
    Console().print(table)


@database_app.callback(invoke_without_command=False)
def _database_commands() -> None:
    """Look into a database."""


@database_app.command()
def info(database: DatabaseFolder, as_json: Json = False) -> None:
    """What is in a database.

    Example: ssrvlad db info town.ssrdb
    """
    report = _info(database)
    if as_json:
        _print_json(report)
        return
    for name, value in report.items():
        entries = value.items() if isinstance(value, dict) else ()
        text = ", ".join(f"{key} {entry}" for key, entry in entries) if entries else value
        print(f"{name.replace('_', ' ')}: {text}")


def _load(
    database: Path,
    sources: Sequence[str],
    labels_as: str | None,
    temporal: int,
    selection: tuple[str | None, int, int],
    segmenting: tuple[Path | None, Path | None],
    workers: int,
    dataset: Dataset | None,
) -> tuple[FrameSet, FrameSet, list[Refusal]]:
    """The frames of a database after Eq. 3, the queries encoded alike, and the refused ones."""

    opened = Database.open(database)
    references = opened.load(temporal)
    if not references.frames:
        raise ValueError(f"{database} holds no frames yet")
    labels_as = labels_as or (dataset and dataset.labels_as) or opened.config.labels_as
    config = dataclasses.replace(opened.config, labels_as=labels_as)
    files, labeller = _find(sources, selection, segmenting, labels_as, dataset)
    with _progress("encoding", len(files)) as advance:
        queries, refused = encode_to_memory(SSRVLAD(config), files, workers, advance, labeller)
    return references, queries, refused


def _find(
    sources: Sequence[str],
    selection: tuple[str | None, int, int],
    segmenting: tuple[Path | None, Path | None],
    labels_as: str,
    dataset: Dataset | None,
) -> tuple[list[FrameFile], Segmenter | None]:
    """The frames of some sources, and what makes label maps of them if they are images."""
    network, cache = segmenting
    if network is None:
        if cache is not None:
            raise ValueError("--segmenter-cache wants a --segmenter")
        if dataset:
            return dataset.label_files(*selection[1:]), None
        return find_label_files(sources, *selection), None
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"
    labeller = Segmenter.load(network, labels_as, cache or user_cache)
    if dataset:
        return dataset.image_files(*selection[1:]), labeller
    return find_image_files(sources, *selection), labeller


def _dataset(
    sources: Sequence[str],
    layout: str | None,
    split: Sequence[str] | None,
    role: Role | None,
    labels: Path | None,
    labels_as: str | None,
) -> Dataset | None:
    """The chosen sequences of a data set, if the source is one; what it lacks is noted."""
    if layout is None:
        if split or role or labels:
            raise ValueError("--split, --role and --labels want a --layout, for example auto")
        return None
    if len(sources) != 1:
        raise ValueError(f"--layout wants the folder of one data set, got {len(sources)} sources")
    name = None if layout == "auto" else layout
    dataset = open_dataset(sources[0], name, labels, labels_as).select(split or (), role)
    for warning in dataset.warnings:
        _note(warning)
    return dataset


def _check_tolerance(
    ground_truth: Path | None, metres: float | None, degrees: float | None, frames: int | None
) -> None:
    given = sum(value is not None for value in (ground_truth, metres, frames))
    if given != 1:
        raise ValueError(
            "wanted one of --ground-truth, --tolerance-metres and --tolerance-frames, "
            f"got {given} of them"
        )
    if degrees is not None and metres is None:
        raise ValueError("--tolerance-degrees wants --tolerance-metres beside it")


def _true_matches(
    ground_truth: Path | None,
    tolerance: tuple[float | None, float | None, int | None],
    queries: FrameSet,
    references: FrameSet,
    refused: Sequence[Refusal],
) -> Known:
    """True matches of each query; the refused ones keep their place where frames are counted."""
    if not queries.frames:
        return []
    metres, degrees, frames = tolerance
    if metres is not None:
        return [*from_poses(queries.poses, references.poses, metres, degrees)]
    asked = sorted((*queries.frames, *(refusal.frame for refusal in refused)), key=_natural_order)
    if ground_truth is not None:
        truth = from_file(ground_truth, asked, references.frames)
    else:
        assert frames is not None
        truth = [*from_frame_numbers(asked, references.frames, frames)]
    of_frame = dict(zip(asked, truth, strict=True))
    return [of_frame[frame] for frame in queries.frames]


def _natural_order(frame: str) -> tuple[list[tuple[int, int, str]], ...]:
    sequence, _, name = frame.rpartition("/")
    return natural_key(sequence), natural_key(name)


def _similarity(queries: FrameSet, references: FrameSet) -> npt.NDArray[np.float32]:
    """Cosines of all pairs, ``(Q, R)``; -inf where a frame is empty and matches nothing."""
    cosines: npt.NDArray[np.float32] = (queries.descriptors @ references.descriptors.T).numpy()
    cosines[queries.empty] = -np.inf
    cosines[:, references.empty] = -np.inf
    return cosines


def _info(path: Path) -> dict[str, Any]:

    database = Database.open(path)
    frames = database.load()
    spaces = database.table(["labels_as"])["labels_as"].to_pylist()
    return {
        "frames": len(frames.frames),
        "sequences": dict(Counter(frames.sequences)),
        "empty": int(frames.empty.sum()),
        "with_pose": sum(not math.isnan(x) for x in frames.poses[:, 0]),
        "label_spaces": dict(Counter(spaces)),
        "preset": database.config.preset,
        "fingerprint": database.fingerprint,
        "config": database.config.to_dict(),
    }


def _print_metrics(metrics: Mapping[str, Any]) -> None:
    table = Table("metric", "value")
    for n, rate in metrics["recall_at"].items():
        table.add_row(f"RecallRate@{n}", f"{rate:.3f}")
    table.add_row("AUC-PR", f"{metrics['auc_pr']:.3f}")
    table.add_row("Recall@100%Precision", f"{metrics['recall_at_100_precision']:.3f}")
    Console().print(table)
    _print_counts(metrics)


def _print_evaluation(metrics: Mapping[str, Any]) -> None:
    """All figures with their intervals, and the thresholds that one may choose."""
    table, intervals = Table("metric", metrics["convention"], "95 % interval"), metrics["intervals"]
    for n, rate in metrics["recall_at"].items():
        table.add_row(f"RecallRate@{n}", _figure(rate), _interval(intervals["recall_at"][n]))
    for key, name in FIGURES.items():
        table.add_row(name, _figure(metrics[key]), _interval(intervals[key]))
    Console().print(table)
    points = metrics["thresholds"]
    table = Table("threshold for", "score", "precision", "lower end", "recall", "accepted")
    for precision, point in points["at_precision"].items():
        table.add_row(f"precision {precision}", *_point(point))
    for recall, point in points["at_recall"].items():
        table.add_row(f"recall {recall}", *_point(point))
    table.add_row("suggested", *_point(points["suggested"]))
    Console().print(table)
    _print_counts(metrics)


def _point(point: Mapping[str, Any] | None) -> list[str]:
    if point is None:
        return ["none"]
    shares = [_figure(point[key]) for key in ("precision", "precision_low", "recall")]
    return [f"{point['score']:.4f}", *shares, str(point["accepted"])]


def _figure(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _interval(ends: Sequence[float]) -> str:
    return "-" if math.isnan(ends[0]) else f"{ends[0]:.3f} to {ends[1]:.3f}"


def _print_counts(metrics: Mapping[str, Any]) -> None:
    print(
        f"{metrics['queries']} queries ({metrics['queries_with_match']} with a true match) against "
        f"{metrics['references']} references, fingerprint {metrics['fingerprint']}"
    )


def _print_json(value: Mapping[str, Any]) -> None:
    print(json.dumps(_without_nan(value)), flush=True)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: a figure without a meaning is null."""
    if isinstance(value, Mapping):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _finish(refused: Sequence[Refusal]) -> None:
    for refusal in refused:
        _note(f"refused {refusal.frame}: {refusal.reason}")
    if refused:
        raise typer.Exit(SOME_REFUSED)


@contextmanager
def _progress(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar on stderr; only on a terminal, so that logs stay clean."""
    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.advance(task, done)


def _note(message: str) -> None:
    print(f"ssrvlad: {' '.join(message.split())}", file=sys.stderr)


def _complain(message: str) -> int:
    _note(message)
    return WRONG_USE
