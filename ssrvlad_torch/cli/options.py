"""The options that several commands take.

An options class is a frozen dataclass whose fields are options. A command takes it as one
parameter; `expand` puts the fields in its place on the command line, and the command gets the
object back:

    def query(database: DatabaseFolder, source: SourceOptions, top: Annotated[int, ...] = 5): ...

To add an option to all commands that share a class, add a field with a default to the class:
``name: Annotated[type, typer.Option(help="...")] = default``. To add one to a single command, add
a parameter to its function. Nothing here may import torch: ``ssrvlad --help`` is to be quick.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from ..baselines import METHODS
from ..evaluation.metrics import Convention

DatabaseFolder = Annotated[str, typer.Argument(help="Folder or URI of the database.")]
AsOf = Annotated[
    int | None, typer.Option("--as-of", help="Version of the database, see ssrvlad db history.")
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
        help="Describe each image by this method, too: recognition then uses both. Say it when the "
        "database is made. It wants a --segmenter.",
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


@dataclass(frozen=True)
class SourceOptions:
    """Where frames come from, which of them are taken, and how images become label maps."""

    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="Folders, globs or files of label maps, or of images with --segmenter; a folder "
            "is a sequence, and so is a ROS bag of images.",
        ),
    ]
    labels_as: Annotated[
        str | None,
        typer.Option(
            help="Label space of the ids: a name or a .yaml file. Without it, the class names of "
            "the segmenter decide (auto), or else the database or the data set."
        ),
    ] = None
    layout: Annotated[
        str | None,
        typer.Option(
            help="SOURCE is the folder of a data set: auto, or extended-cmu, robotcar-seasons, "
            "synthia, cityscapes, camvid, vpr-bench, folders.",
        ),
    ] = None
    split: Annotated[
        list[str] | None,
        typer.Option(help="With --layout: a sequence to take, * for any text; repeatable."),
    ] = None
    role: Annotated[
        Literal["reference", "query"] | None,
        typer.Option(help="With --layout: take the references only, or the queries only."),
    ] = None
    labels: Annotated[
        Path | None,
        typer.Option(help="With --layout: other label maps than the data set's own."),
    ] = None
    sequence: Annotated[
        str | None, typer.Option(help="Name of the sequence. Without it, the name of the folder.")
    ] = None
    poses: Annotated[
        str | None,
        typer.Option(
            help="Where frames were taken: a .csv file, a file of KITTI or TUM, or exif. Without "
            "it, poses.csv in or beside a folder, or @UTM@ fields of file names."
        ),
    ] = None
    topic: Annotated[
        str | None, typer.Option(help="Topic of a ROS bag that has several topics of images.")
    ] = None
    every: Annotated[int, typer.Option(min=1, help="Take every N-th frame of a sequence.")] = 1
    start: Annotated[int, typer.Option(min=0, help="First frame to take of a sequence.")] = 0
    segmenter: Annotated[
        str | None,
        typer.Option(
            help="Network that labels images: FILE.onnx, FILE.yaml with a network and its "
            "settings, hf:ORG/NAME[@REVISION], a folder, torchhub:REPO/MODEL or MODULE:NAME.",
        ),
    ] = None
    classes: Annotated[
        str | None,
        typer.Option(help="Channels of the network to use, FIRST:LAST, for example 0:19."),
    ] = None
    segmenter_cache: Annotated[
        Path | None,
        typer.Option(
            help="Folder that keeps the segmenter's label maps. Without it, ~/.cache/ssrvlad."
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Frames to encode at the same time. Without it, one for each core."
        ),
    ] = None

    @property
    def takes_all(self) -> bool:
        """Whether no frame of a sequence is left out."""
        return (self.every, self.start) == (1, 0)


@dataclass(frozen=True)
class DriveOptions:
    """The references and the queries of one data set, or of two folders."""

    dataset: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of a data set. Without it, --references and --queries are folders."
        ),
    ] = None
    references: Annotated[
        list[str] | None,
        typer.Option(
            help="A sequence of the data set, * for any text; repeatable. Without it, the data "
            "set's own references."
        ),
    ] = None
    queries: Annotated[list[str] | None, typer.Option(help="The same for queries.")] = None
    odd_even: Annotated[
        bool,
        typer.Option(
            "--odd-even",
            help="Even frames of each drive are references, odd ones are queries.",
        ),
    ] = False
    layout: Annotated[
        str | None,
        typer.Option(help="Layout of the data set. Without it, the layout is recognised."),
    ] = None
    labels: Annotated[
        Path | None, typer.Option(help="Other label maps than the data set's own.")
    ] = None
    labels_as: Annotated[
        str | None,
        typer.Option(
            help="Label space of the label maps: a name or a .yaml file. Without it, the data "
            "set's. With it, a PNG that could be an image or a label map is a label map."
        ),
    ] = None


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
    """What is done between descriptors and a decision."""

    standardise: Annotated[
        bool, typer.Option(help="Subtract the mean descriptor of each traverse.")
    ] = True
    sweep: Annotated[
        bool,
        typer.Option(
            help="Describe each query from several anchors: this helps if the camera is turned or "
            "moved aside. The scores decide how many anchors count."
        ),
    ] = True
    follow: Annotated[
        Literal["offline", "online", "no"],
        typer.Option(
            help="Judge each query together with its sequence: with all queries (offline), with "
            "the earlier ones (online), or alone (no). Queries that do not form a sequence are "
            "judged alone."
        ),
    ] = "offline"
    delay: Annotated[
        int,
        typer.Option(
            min=0, help="With --follow online: later queries to wait for before an answer."
        ),
    ] = 0


@dataclass(frozen=True)
class RecognitionOptions(StepOptions):
    """What is done with descriptors before a place is decided."""

    temporal: Annotated[
        str | None,
        typer.Option(
            metavar="T",
            help="Sum each reference descriptor over T frames on each side (Eq. 3), or, as 10m, "
            "over as many frames as the sequence takes for so many metres. Without it, no sum.",
        ),
    ] = None
    as_paper: Annotated[
        bool,
        typer.Option(
            "--as-paper",
            help="Decide as the paper does: single frames, their cosine, the sum of Eq. 3 with "
            "t = 3, and no other step.",
        ),
    ] = False
    fuse: Annotated[
        bool | None,
        typer.Option(
            help="Use descriptors of pictures too. Without it, if the database holds them "
            "(ssrvlad encode --with)."
        ),
    ] = None
    min_confidence: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Leave out queries whose first candidate is right with less probability.",
        ),
    ] = 0.0

    @property
    def reach(self) -> Reach:
        """What is summed on each side.

        Raises:
            ValueError: it is neither frames nor metres.
        """
        if self.temporal is not None:
            return Reach.of(self.temporal)
        return Reach(3 if self.as_paper else 0)


@dataclass(frozen=True)
class TruthOptions:
    """What counts as a true match, and by whose convention the figures are computed."""

    ground_truth: Annotated[
        Path | None,
        typer.Option(
            help="Pairs of frame ids (.json, .csv), a 0/1 matrix (.npy, .npz, .csv) or VPR-Bench's "
            "ground_truth_new.npy. Without any, the ground truth of the data set.",
        ),
    ] = None
    tolerance_metres: Annotated[
        float | None,
        typer.Option(help="Or: true matches are at most so many metres away, by poses.csv."),
    ] = None
    tolerance_degrees: Annotated[
        float | None,
        typer.Option(help="With --tolerance-metres: headings differ by at most so many degrees."),
    ] = None
    tolerance_frames: Annotated[
        int | None,
        typer.Option(
            help="Or: true matches are at most so many frames away. All frames of a data set count."
        ),
    ] = None
    convention: Annotated[
        Convention,
        typer.Option(help="Convention that the figures follow."),
    ] = "exact"


@dataclass(frozen=True)
class MethodOptions:
    """Another method, and its settings as they were typed."""

    method: Annotated[
        str | None,
        typer.Option(
            help=f"Another method, which reads label maps or images: {', '.join(METHODS)}."
        ),
    ] = None
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting of the method, NAME=VALUE; repeatable."),
    ] = None
    weights: Weights = None
    vocabulary: Annotated[
        Path | None, typer.Option(help="Vocabulary of the method, see ssrvlad vocabulary.")
    ] = None
    random_weights: RandomWeights = False

    @property
    def named(self) -> dict[str, Any]:
        """The settings that have an option of their own, those that were given."""
        given = {
            "weights": self.weights,
            "vocabulary": self.vocabulary,
            "random_weights": self.random_weights,
        }
        return {name: value for name, value in given.items() if value}


def expand(command: Callable[..., None]) -> Callable[..., None]:
    """The command with each parameter that is an options class replaced by the class's fields."""
    parameters: list[inspect.Parameter] = []
    classes: dict[str, type] = {}
    types = get_type_hints(command, include_extras=True)
    for parameter in inspect.signature(command).parameters.values():
        kind = types[parameter.name]
        if is_dataclass(kind):
            assert isinstance(kind, type)
            classes[parameter.name] = kind
            parameters += _parameters(kind)
        else:
            keyword = inspect.Parameter.KEYWORD_ONLY
            parameters.append(parameter.replace(kind=keyword, annotation=kind))

    @wraps(command)
    def run(**given: Any) -> None:
        for name, kind in classes.items():
            given[name] = kind(**{field.name: given.pop(field.name) for field in fields(kind)})
        command(**given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _parameters(options: type) -> list[inspect.Parameter]:
    types = get_type_hints(options, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=types[field.name],
        )
        for field in fields(options)
    ]
