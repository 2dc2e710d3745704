"""Arguments and options that several commands take, and groups of them to pass on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..datasets.dataset import Role
from ..evaluation.metrics import Convention

Sources = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE...",
        help="Folders, globs or files of label maps, or of images with --segmenter; a folder is a "
        "sequence.",
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
Splits = Annotated[
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
TruthFile = Annotated[
    Path | None,
    typer.Option(
        "--ground-truth",
        help="Pairs of frame ids (.json, .csv), a 0/1 matrix (.npy, .npz, .csv) or VPR-Bench's "
        "ground_truth_new.npy; with a data set its own if nothing is given.",
    ),
]
Metres = Annotated[
    float | None,
    typer.Option("--tolerance-metres", help="Or: true matches are this near, by poses.csv."),
]
Degrees = Annotated[
    float | None,
    typer.Option(
        "--tolerance-degrees", help="With --tolerance-metres: and their headings this alike."
    ),
]
FrameCount = Annotated[
    int | None,
    typer.Option(
        "--tolerance-frames",
        help="Or: true matches are at most so many frames away; of a data set all frames count.",
    ),
]
ConventionName = Annotated[
    Convention, typer.Option("--convention", help="Whose way of computing it is.")
]
Weights = Annotated[
    Path | None,
    typer.Option(
        help="Weights of the method's network, or their folder; ~/.cache/ssrvlad/weights if not "
        "given."
    ),
]
RandomWeights = Annotated[
    bool, typer.Option("--random-weights", help="Only to measure what the method costs.")
]
Workers = Annotated[int, typer.Option(min=1, help="Threads that read ahead.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Frames = Annotated[int, typer.Option(min=2, help="Frames of each traverse.")]
Seed = Annotated[int, typer.Option(min=0, help="Another seed is another city.")]


@dataclass(frozen=True)
class Choosing:
    """What is taken of a data set: its layout, sequences, their role, and other label maps."""

    layout: str | None
    splits: Sequence[str] | None
    role: Role | None
    labels: Path | None


@dataclass(frozen=True)
class Selection:
    """Which frames are taken of each sequence, and what it is called."""

    sequence: str | None
    every: int
    start: int


@dataclass(frozen=True)
class Segmenting:
    """The network that makes label maps of images, and where they are kept."""

    network: Path | None
    cache: Path | None
