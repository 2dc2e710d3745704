"""The options that several commands take. An options class is a frozen dataclass whose fields are
options; a command takes it as one parameter, and `expand` turns the fields into options of the
command line:

    def query(*, source: FrameSelection, top: int = option("Number of candidates.", default=5)): ...

Help lists options by groups, and rare ones, ``hidden=True``, only with ``--help-all``. This module
imports no torch, so that ``ssrvlad --help`` is quick."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_type_hints

import typer
from typer.core import TyperCommand

from ..channels import LABEL_SHAPES
from ..evaluation.metrics import Convention
from .output import results_alone

if TYPE_CHECKING:
    from ..recognition.recognise import Steps

PAPER_REACH, MOST_REACH = 3, 1_000_000
"""Frames on each side of the temporal sum: in the paper, and at most."""

DatabaseFolder = Annotated[str, typer.Argument(help="Folder or URI of the database.")]
AsOf = Annotated[
    int | None,
    typer.Option(
        "--as-of",
        min=1,
        help="Version of the database to read, see ssrvlad db history. Default: the newest.",
    ),
]
Preset = Annotated[str, typer.Option(help="paper (SSR-VLAD) or default (ours).")]
MaybePreset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help="paper (SSR-VLAD) or default (ours). Default: the preset of the database, or default "
        "for a new one.",
    ),
]
StoredChannels = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        metavar="features|hog",
        help="What to store of each image beside the descriptor of its label map; recognition then "
        "uses all. features: what the encoder of the network sees, in the pass that labels the "
        "image. Can be repeated; ssr-vlad alone stores nothing beside it. Needs --segmenter. "
        "Default: both, or hog if the network has no features. A database has these descriptors "
        "from its first frame on, or never.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", help="Print scores, and the steps that were taken, too.")
]
Seed = Annotated[int, typer.Option(min=0, help="Another seed gives another city.")]


def option(help: str, *flags: str, default: object = None, **settings: Any) -> Any:
    """An option: a field of an options class, or the default of a command's parameter. Without
    flags, its name is that of the field. An option with the default ``...`` is required."""
    return field(default=default, metadata={"help": help, "flags": flags, **settings})


def switch(name: str, help: str, **settings: Any) -> Any:
    """An option without a value that is off by default, and has no ``--no-`` form."""
    return option(help, name, default=False, **settings)


def argument(help: str, metavar: str | None = None, **default: Any) -> Any:
    """An argument: a field of an options class, or the default of a command's parameter."""
    return field(metadata={"help": help, "metavar": metavar}, **default)


@dataclass(frozen=True)
class StepOptions:
    """The steps between descriptors and a decision."""

    GROUP = "Matching"

    standardise: bool = option(
        "Subtract the mean descriptor of each sequence.", default=True, hidden=True
    )
    sweep: bool = option(
        "Describe each query from several anchors, which helps if the camera is turned or moved "
        "aside. The scores decide how many anchors are used.",
        default=True,
        hidden=True,
    )
    follow: Literal["offline", "online", "no"] = option(
        "Match each query with all queries of its sequence (offline), with the earlier ones "
        "(online), or as a single frame (no), as also where a sequence makes no answer surer.",
        default="offline",
    )
    delay: int = option(
        "With --follow online: number of later queries to wait for before an answer.",
        default=0,
        min=0,
    )

    def steps(self) -> Steps:
        """The chosen steps."""
        from ..recognition.recognise import Steps

        follow = None if self.follow == "no" else self.follow
        return Steps(self.standardise, self.sweep, follow, self.delay)


@dataclass(frozen=True)
class AnswerOptions:
    """Which frames of a database are candidates, and which answers are accepted."""

    GROUP = "Answers"

    min_confidence: float = option(
        "Print no candidate of a query with a lower confidence, the probability that its first "
        "candidate is right.",
        default=0.0,
        min=0,
        max=1,
    )
    max_wrong: float | None = option(
        "Print candidates of as many queries as possible while at most this fraction of them is "
        "estimated to be wrong, such as 0.05. That needs no ground truth.",
        min=0,
        max=1,
    )
    near: str | None = option(
        "Use only candidates whose pose is at most METRES from X, Y, in metres of the map.",
        metavar="X,Y,METRES",
    )
    channels: list[str] | None = option(
        "Use only this channel of the database: ssr-vlad (label maps), features or hog, see "
        "ssrvlad encode; can be repeated. Default: all that it has.",
        "--channel",
        hidden=True,
    )

    def __post_init__(self) -> None:
        if self.near is not None:
            from ..search.selection import Near

            Near.of(self.near)
        if self.max_wrong is not None and self.min_confidence:
            raise ValueError("--max-wrong chooses the least confidence; leave out --min-confidence")


@dataclass(frozen=True)
class RecognitionOptions(StepOptions, AnswerOptions):
    """All steps from the descriptors of a database to a decision."""

    temporal: int | None = option(
        "Sum each reference descriptor over T frames on each side (Eq. 3), such as 3. Default: no "
        "sum.",
        metavar="T",
        min=0,
        max=MOST_REACH,
        hidden=True,
    )
    as_paper: bool = switch(
        "--as-paper",
        "Decide as in the paper: cosines of single frames, the temporal sum with t = 3, and no "
        "other step. Options that contradict this are refused.",
        hidden=True,
    )

    def checked(self, typed: Collection[str]) -> Self:
        """The options, with all that `as_paper` means; of the names of options on the command line,
        ``typed``, those that contradict it are a ValueError."""
        if not self.as_paper:
            return self
        paper: dict[str, Any] = {"standardise": False, "sweep": False, "follow": "no", "delay": 0}
        paper |= {"channels": [LABEL_SHAPES], "temporal": PAPER_REACH}
        contradicting = [
            "--channel" if name == "channels" else f"--{name}"
            for name, value in paper.items()
            if name in typed and getattr(self, name) != value
        ]
        if contradicting:
            raise ValueError(
                f"--as-paper means --no-standardise --no-sweep --follow no --temporal {PAPER_REACH}"
                f" --channel {LABEL_SHAPES}; it contradicts {' and '.join(contradicting)}"
            )
        return replace(self, **paper)

    def settings(self) -> dict[str, Any]:
        """What `Map.query` takes of them."""
        return {
            "steps": self.steps(),
            "temporal": self.temporal or 0,
            "channels": self.channels,
            "near": self.near,
            "min_confidence": self.min_confidence,
            "max_wrong": self.max_wrong,
        }


@dataclass(frozen=True)
class TruthOptions:
    """The definition of a true match, and the convention of the metrics."""

    GROUP = "Ground truth"

    ground_truth: Path | None = option(
        "Ground truth: pairs of frames by their ids or the ends of their paths (.json, .csv), a "
        "0/1 matrix (.npy). Default: the ground truth of the data set."
    )
    tolerance_metres: float | None = option(
        "Instead of a ground truth: largest distance of a true match in metres, by the poses. "
        "Frames of unknown pose are left out."
    )
    tolerance_degrees: float | None = option(
        "With --tolerance-metres: largest difference of the headings of a true match."
    )
    tolerance_frames: int | None = option(
        "Instead of a ground truth: largest distance of a true match in frames. All frames of a "
        "data set count, also those that are not used."
    )
    convention: Convention = option(
        "Convention by which the metrics are computed.", default="exact"
    )

    @property
    def definition(self) -> tuple[Path | None, float | None, float | None, int | None]:
        """What `GroundTruth.chosen` takes beside the declared one."""
        metres = self.tolerance_metres
        return self.ground_truth, metres, self.tolerance_degrees, self.tolerance_frames


def expand(command: Callable[..., None]) -> Callable[..., None]:
    """The command in the form that typer expects: each field of an options class is a parameter of
    its own. Typer calls the command with a value for each; the options classes are made of them
    again. If one has a method ``checked``, that is called with the names of the options on the
    command line, and gives what the command gets."""
    types = get_type_hints(command, include_extras=True)
    classes: dict[str, Any] = {name: kind for name, kind in types.items() if is_dataclass(kind)}
    options = {
        name: [option for option in fields(kind) if option.metadata]
        for name, kind in classes.items()
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name in classes:
            hints = get_type_hints(classes[name], include_extras=True)
            parameters += [
                _parameter(f.name, hints[f.name], f, _group_of(classes[name], f.name))
                for f in options[name]
            ]
        else:
            parameters.append(_parameter(name, types[name], parameter.default))
    if any(option.metadata.get("hidden") for fields in options.values() for option in fields):
        parameters.append(_parameter("help_all", bool, _HELP_ALL))
    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)

    @wraps(command)
    def run(*, context: typer.Context, **values: Any) -> None:
        values.pop("help_all", None)  # its callback prints it
        source_of = context.get_parameter_source
        typed = [n for n in values if (s := source_of(n)) and s.name == "COMMANDLINE"]
        for name, kind in classes.items():
            values[name] = kind(**{o.name: values.pop(o.name) for o in options[name]})
            if hasattr(kind, "checked"):
                values[name] = values[name].checked(typed)
        with results_alone():
            command(**values)

    run.__signature__ = inspect.Signature([*parameters, context])  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__annotations__["context"] = typer.Context
    return run


class GroupedCommand(TyperCommand):
    """A command whose help lists its options in their groups."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes the arguments and options that are not hidden."""
        groups: dict[str, list[Any]] = {"Arguments": []}
        for parameter in self.get_params(ctx):
            is_argument = parameter.param_type_name == "argument"
            group = getattr(parameter, "rich_help_panel", None) or "Options"
            if record := parameter.get_help_record(ctx):
                groups.setdefault("Arguments" if is_argument else group, []).append(record)
        for group in sorted(filter(groups.get, groups), key="Options".__eq__):  # these last
            with formatter.section(group):
                formatter.write_dl(groups[group])


def _print_all_help(context: typer.Context, is_asked: bool) -> None:
    """Prints the help with all options, and ends."""
    if is_asked:
        rare = [parameter for parameter in context.command.params if parameter.hidden]  # type: ignore[attr-defined]
        for parameter in rare:
            parameter.hidden = False  # type: ignore[attr-defined]
        print(context.get_help())
        for parameter in rare:
            parameter.hidden = True  # type: ignore[attr-defined]
        raise typer.Exit


_HELP_ALL = switch(
    "--help-all", "Show also the rare options, and exit.", is_eager=True, callback=_print_all_help
)


def _group_of(options: type, name: str) -> str | None:
    """The group of an option: that of the class that has it first."""
    classes = (kind for kind in reversed(options.__mro__) if name in inspect.get_annotations(kind))
    return getattr(next(classes), "GROUP", None)


def _parameter(name: str, kind: Any, default: Any, group: str | None = None) -> inspect.Parameter:
    """A parameter of the command line, whose default may be a field with typer's settings."""
    if isinstance(default, Field):
        settings = dict(default.metadata)
        flags = settings.pop("flags", None)
        group = settings.pop("group", group)
        if settings:
            settings["rich_help_panel"] = group
            new = typer.Argument(**settings) if flags is None else typer.Option(*flags, **settings)
            kind = Annotated[kind, new]
        default = default.default
    default = inspect.Parameter.empty if default in (MISSING, ...) else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
