"""The options that several commands take.

An options class is a frozen dataclass whose fields are options. A command takes it as one
parameter; `expand` puts the fields in its place on the command line, and the command gets the
object back:

    def query(*, source: SourceOptions, top: int = option(5, "Candidates of each query.")): ...

To add an option to all commands that share a class, add a field to the class:
``name: type = option(default, "help")``. To add one to a single command, add a parameter to its
function. Nothing here may import torch, so that ``ssrvlad --help`` is quick.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from ..baselines import METHODS
from ..evaluation.metrics import Convention

DatabaseFolder = Annotated[str, typer.Argument(help="Folder or URI of the database.")]
AsOf = Annotated[
    int | None,
    typer.Option("--as-of", min=1, help="Version of the database, see ssrvlad db history."),
]
LabelsAs = Annotated[str, typer.Option(help="Label space of the ids: a name or a .yaml file.")]
Preset = Annotated[str, typer.Option(help="paper (SSR-VLAD) or default (ours).")]
MaybePreset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help="paper (SSR-VLAD) or default (ours). Without it, the preset of the database.",
    ),
]
With = Annotated[
    Literal["hog"] | None,
    typer.Option(
        "--with",
        help="Describe each image by this method, too: recognition then uses both. Only when the "
        "database is new. It wants a --segmenter.",
    ),
]
Workers = Annotated[int, typer.Option(min=1, help="Threads that read ahead.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Frames = Annotated[int, typer.Option(min=2, help="Frames of each traverse.")]
Seed = Annotated[int, typer.Option(min=0, help="Another seed gives another city.")]
Weights = Annotated[
    Path | None,
    typer.Option(
        help="Weights of the method's network, or their folder. Without it, "
        "~/.cache/ssrvlad/weights."
    ),
]
RandomWeights = Annotated[
    bool, typer.Option("--random-weights", help="Random weights, only to measure costs.")
]


def option(default: object, help: str, *flags: str, **settings: Any) -> Any:
    """An option: a field of an options class, or the default of a command's parameter.

    Without flags, its name is that of the field. A default of ``...`` means that it must be given.
    """
    return field(default=default, metadata={"typer": typer.Option(*flags, help=help, **settings)})


def argument(help: str, metavar: str | None = None, **default: Any) -> Any:
    """An argument, likewise."""
    return field(metadata={"typer": typer.Argument(help=help, metavar=metavar)}, **default)


@dataclass(frozen=True)
class SourceOptions:
    """Where frames come from, which of them are taken, and how images become label maps."""

    paths: list[str] = argument(
        "Folders, globs or files of label maps, or of images with --segmenter; a folder "
        "is a sequence, and so is a ROS bag of images.",
        metavar="SOURCE...",
    )
    labels_as: str | None = option(
        None,
        "Label space of the ids: a name or a .yaml file. Without it, the class names of "
        "the segmenter decide (auto), or else the database or the data set.",
    )
    layout: str | None = option(
        None,
        "SOURCE is the folder of a data set: auto, or extended-cmu, robotcar-seasons, "
        "synthia, cityscapes, camvid, vpr-bench, folders.",
    )
    split: list[str] | None = option(
        None, "With --layout: a sequence to take, * for any text; repeatable."
    )
    role: Literal["reference", "query"] | None = option(
        None, "With --layout: take the references only, or the queries only."
    )
    labels: Path | None = option(None, "With --layout: other label maps than the data set's own.")
    sequence: str | None = option(
        None,
        "Name of the sequence. Without it, the one that the folder has in the database, or else "
        "the end of the folder's path that no other folder has.",
    )
    poses: str | None = option(
        None,
        "Where frames were taken: a .csv file, a file of KITTI or TUM, or exif. Without "
        "it, poses.csv in or beside a folder, or @UTM@ fields of file names.",
    )
    topic: str | None = option(None, "Topic of a ROS bag that has several topics of images.")
    every: int = option(1, "Take every N-th frame of a sequence.", min=1)
    start: int = option(0, "First frame to take of a sequence.", min=0)
    segmenter: str | None = option(
        None,
        "Network that labels images: FILE.onnx, FILE.yaml with a network and its "
        "settings, hf:ORG/NAME[@REVISION], a folder, torchhub:REPO/MODEL or MODULE:NAME.",
    )
    classes: str | None = option(
        None, "Channels of the network to use, FIRST:LAST, for example 0:19."
    )
    segmenter_cache: Path | None = option(
        None, "Folder that keeps the segmenter's label maps. Without it, ~/.cache/ssrvlad."
    )
    workers: int | None = option(
        None, "Frames to encode at the same time. Without it, one for each core.", min=1
    )

    @property
    def takes_all(self) -> bool:
        """Whether no frame of a sequence is left out."""
        return (self.every, self.start) == (1, 0)


@dataclass(frozen=True)
class DriveOptions:
    """The references and the queries of one data set, or of two folders."""

    dataset: Path | None = argument(
        "Folder of a data set. Without it, --references and --queries are folders.", default=None
    )
    references: list[str] | None = option(
        None,
        "A sequence of the data set, * for any text; repeatable. Without it, the data "
        "set's own references.",
    )
    queries: list[str] | None = option(None, "The same for queries.")
    odd_even: bool = option(
        False, "Even frames of each drive are references, odd ones are queries.", "--odd-even"
    )
    layout: str | None = option(
        None, "Layout of the data set. Without it, the layout is recognised."
    )
    labels: Path | None = option(None, "Other label maps than the data set's own.")
    labels_as: str | None = option(
        None,
        "Label space of the label maps: a name or a .yaml file. Without it, the data "
        "set's. Without it, PNGs that could be either are taken as images.",
    )


PAPER_REACH = 3
"""Frames on each side of the temporal sum in the paper."""


@dataclass(frozen=True)
class Reach:
    """How far the temporal sum of Eq. 3 reaches on each side: in frames, or, where they are given,
    in metres."""

    frames: int = 0
    metres: float | None = None

    @classmethod
    def of(cls, text: str) -> Reach:
        """From ``3`` (frames) or ``10m`` (metres)."""
        try:
            reach = cls(0, float(text[:-1])) if text.endswith("m") else cls(int(text))
        except ValueError:
            reach = cls(-1)
        if reach.frames < 0 or not 0 <= (reach.metres or 0) < math.inf:
            raise ValueError(f"--temporal wants frames, as 3, or metres, as 10m, got {text!r}")
        return reach

    def __bool__(self) -> bool:
        return bool(self.frames or self.metres)

    def __str__(self) -> str:
        return str(self.frames) if self.metres is None else f"{self.metres:g}m"


@dataclass(frozen=True)
class StepOptions:
    """The steps between descriptors and a decision."""

    standardise: bool = option(True, "Subtract the mean descriptor of each traverse.")
    sweep: bool = option(
        True,
        "Describe each query from several anchors: this helps if the camera is turned or "
        "moved aside. The scores decide how many anchors count.",
    )
    follow: Literal["offline", "online", "no"] = option(
        "offline",
        "Judge each query together with its sequence: with all queries (offline), with "
        "the earlier ones (online), or alone (no). Queries whose scores do not form a sequence "
        "are judged alone; the last line says what was done.",
    )
    delay: int = option(
        0, "With --follow online: later queries to wait for before an answer.", min=0
    )


@dataclass(frozen=True)
class RecognitionOptions(StepOptions):
    """All steps from the descriptors of a database to a decision."""

    temporal: str | None = option(
        None,
        "Sum each reference descriptor over T frames on each side (Eq. 3), or, as 10m, "
        "over as many frames as the sequence takes for so many metres. Without it, no sum.",
        metavar="T",
    )
    as_paper: bool = option(
        False,
        "Decide as the paper does: single frames, their cosine, the sum of Eq. 3 with "
        "t = 3, and no other step. Options that say otherwise are refused.",
        "--as-paper",
    )
    fuse: bool | None = option(
        None,
        "Use descriptors of pictures too. Without it, if the database holds them "
        "(ssrvlad encode --with).",
    )
    min_confidence: float = option(
        0.0, "Leave out queries whose first candidate is right with less probability.", min=0, max=1
    )

    def check(self, typed: Collection[str]) -> None:
        """Refuses what --as-paper contradicts, of the options that were typed.

        Raises:
            ValueError: names them.
        """
        paper = {"standardise": False, "sweep": False, "follow": "no", "delay": 0, "fuse": False}
        others = [n for n, value in paper.items() if n in typed and getattr(self, n) != value]
        if self.temporal is not None and self.reach != Reach(PAPER_REACH):
            others.append("temporal")
        if self.as_paper and others:
            names = " and ".join(f"--{name}" for name in others)
            raise ValueError(
                f"--as-paper stands for --no-standardise --no-sweep --follow no --temporal "
                f"{PAPER_REACH} --no-fuse; got {names} as well"
            )

    @property
    def reach(self) -> Reach:
        """The reach of the temporal sum; other text than frames or metres is a ValueError."""
        if self.temporal is not None:
            return Reach.of(self.temporal)
        return Reach(PAPER_REACH if self.as_paper else 0)


@dataclass(frozen=True)
class TruthOptions:
    """The definition of a true match, and the convention of the figures."""

    ground_truth: Path | None = option(
        None,
        "Pairs of frames, by their ids or what only their paths end in (.json, .csv), a 0/1 "
        "matrix (.npy, .npz, .csv) or VPR-Bench's ground_truth_new.npy. Without any, the "
        "ground truth of the data set.",
    )
    tolerance_metres: float | None = option(
        None, "Or: true matches are at most so many metres away, by poses.csv."
    )
    tolerance_degrees: float | None = option(
        None, "With --tolerance-metres: headings differ by at most so many degrees."
    )
    tolerance_frames: int | None = option(
        None, "Or: true matches are at most so many frames away. All frames of a data set count."
    )
    convention: Convention = option("exact", "Convention that the figures follow.")


@dataclass(frozen=True)
class MethodOptions:
    """Another method, and its settings as the user typed them."""

    method: str | None = option(
        None, f"Another method, which reads label maps or images: {', '.join(METHODS)}."
    )
    settings: list[str] | None = option(
        None, "A setting of the method, NAME=VALUE; repeatable.", "--set"
    )
    weights: Weights = None
    vocabulary: Path | None = option(None, "Vocabulary of the method, see ssrvlad vocabulary.")
    random_weights: RandomWeights = False

    @property
    def named(self) -> dict[str, Any]:
        """The settings that have an option of their own, those that were given."""
        names = ("weights", "vocabulary", "random_weights")
        return {name: value for name in names if (value := getattr(self, name))}


def expand(command: Callable[..., None]) -> Callable[..., None]:
    """The command as typer takes it: each parameter that is an options class is replaced by the
    class's fields, and each `option` or `argument` by typer's. A class may have a method ``check``,
    which is told the names of the options that were typed."""
    parameters: list[inspect.Parameter] = []
    classes: dict[str, type] = {}
    types = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        kind = types[name]
        if is_dataclass(kind):
            assert isinstance(kind, type)
            classes[name] = kind
            own = get_type_hints(kind, include_extras=True)
            parameters += [_parameter(each.name, own[each.name], each) for each in fields(kind)]
        else:
            parameters.append(_parameter(name, kind, parameter.default))

    @wraps(command)
    def run(*, context: typer.Context, **given: Any) -> None:
        typed = [name for name in given if _is_typed(context, name)]
        for name, kind in classes.items():
            given[name] = kind(**{each.name: given.pop(each.name) for each in fields(kind)})
            if hasattr(kind, "check"):
                given[name].check(typed)
        command(**given)

    parameters.append(
        inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    )
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _is_typed(context: typer.Context, name: str) -> bool:
    """Whether an option stands on the command line."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _parameter(name: str, kind: Any, default: Any) -> inspect.Parameter:
    """A parameter whose default may be a field: a plain one, or an `option` or `argument`."""
    if isinstance(default, Field):
        if "typer" in default.metadata:
            kind = Annotated[kind, default.metadata["typer"]]
        default = default.default
    default = inspect.Parameter.empty if default in (MISSING, ...) else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
