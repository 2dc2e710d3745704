"""FrameSelection: the frames that a user means. This module imports no torch."""

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

STDIN = "-"
"""The source whose names arrive on standard input."""

_LEFT_OUT = ("layout", "poses", "topic", "fps", "every", "start", "index_is_id")

NETWORK = (
    "FILE.onnx, FILE.yaml (a network and its settings), hf:ORG/NAME[@REVISION], a folder or "
    "MODULE:NAME."
)


def _option(help: str, default: object = None, **settings: Any) -> Any:
    return field(
        default=default, metadata={"help": help, "flags": (), "group": "Input", **settings}
    )


@dataclass(frozen=True)
class FrameSelection:
    """Where frames come from, which of them are used, and how images become label maps. Each field
    is an option of the command line, whose help says what it means; but ``posed``: leave out frames
    of a data set without a pose, ``None`` if its ground truth is by poses. Options that do not go
    together, and numbers out of range, are a ValueError.

    Examples:
        >>> town.query(FrameSelection(["drive.mp4"], fps=2.0, poses="drive.gpx"))  # doctest: +SKIP
    """

    paths: list[str] = field(
        metadata={
            "help": "Folders, globs or files of label maps; with --segmenter also images, videos "
            "and ROS bags. Each folder, video and bag is one sequence.",
            "metavar": "SOURCE...",
        }
    )
    labels_as: str | None = _option(
        "Label space of the ids: a name, a .yaml file, or auto (by the class names of the "
        "segmenter). Default: the one of the segmenter, else of the data set, else of the "
        "database."
    )
    layout: str | None = _option(
        "SOURCE is the folder of a data set with this layout: auto (recognised), extended-cmu, "
        "robotcar-seasons, synthia, cityscapes, camvid, vpr-bench or folders."
    )
    split: list[str] | None = _option(
        "With --layout: sequence to use; * stands for any text; can be repeated.", hidden=True
    )
    role: Literal["reference", "query"] | None = _option(
        "With --layout: use only the references, or only the queries.", hidden=True
    )
    labels: str | None = _option(
        "With --layout: folder of label maps to use instead of those of the data set.", hidden=True
    )
    sequence: str | None = _option(
        "Name of the sequence. Default: the name that the database has for the folder, else the "
        "shortest end of its path that no other folder has."
    )
    poses: str | None = _option(
        "Poses of the frames: a .csv file (also of EuRoC or RobotCar), a file of KITTI, KITTI-360, "
        "TUM or COLMAP (images.txt), a .gpx file, or exif. Default: poses.csv in or beside the "
        "folder, or the @UTM@ fields of file names."
    )
    topic: str | None = _option(
        "Image topic of a ROS bag; needed only if the bag has several.", hidden=True
    )
    fps: float | None = _option("Use at most this many frames in a second of a video or bag.")
    every: int = _option("Use every N-th frame of a sequence.", default=1, min=1)
    start: int = _option(
        "Number of the first frame of a sequence to use.", default=0, min=0, hidden=True
    )
    segmenter: str | None = _option(
        f"Segmentation network that labels images: {NETWORK} Default: the network that made the "
        "database."
    )
    index_is_id: bool = _option(
        "The index of a palette, or the red channel of colours, is the id of a label map.",
        default=False,
        flags=("--index-is-id",),
    )
    segmenter_cache: str | None = _option(
        "Folder that caches the segmenter's label maps. Default: ~/.cache/ssrvlad.", hidden=True
    )
    workers: int | None = _option(
        "Number of frames to encode at the same time. Default: one for each core.", min=1
    )
    posed: bool | None = False

    def __post_init__(self) -> None:
        if isinstance(self.paths, str) or not self.paths:
            raise ValueError(f"expected a list of folders, files or globs, got {self.paths!r}")
        if self.every < 1 or self.start < 0:
            raise ValueError(
                f"expected every >= 1 and start >= 0, got {self.every} and {self.start}"
            )
        if self.fps is not None and not 0 < self.fps < math.inf:
            raise ValueError(f"expected fps above 0, got {self.fps}")
        if self.layout is None and (self.split or self.role or self.labels):
            raise ValueError("--split, --role and --labels need --layout, such as --layout auto")
        if self.layout is not None and self.changed("sequence", "poses", "topic", "fps"):
            raise ValueError("--sequence, --poses, --topic and --fps do not go with --layout")
        if self.layout is not None and len(self.paths) != 1:
            raise ValueError(
                f"--layout: expected the folder of one data set, got {len(self.paths)} sources"
            )
        if STDIN in self.paths and (len(self.paths) > 1 or self.changed(*_LEFT_OUT)):
            raise ValueError(
                f"SOURCE {STDIN} takes no other SOURCE, no --layout, --poses, --topic, "
                "--fps, --every, --start and --index-is-id"
            )

    @classmethod
    def of(cls, frames: object) -> "FrameSelection":
        """What a user means by folders, globs or files; other things are a ValueError."""
        several = isinstance(frames, Iterable) and not isinstance(frames, str)
        paths: list[Any] = [*frames] if several else [frames]  # type: ignore[misc]
        for path in paths:
            if not isinstance(path, str | os.PathLike):
                raise ValueError(
                    "expected folders, globs or files, or a list of them, got "
                    f"{type(path).__name__}; query and locate take pictures in memory"
                )
        return cls([str(path) for path in paths])

    def changed(self, *names: str) -> list[str]:
        """Those of these fields that are not at their defaults."""
        return [name for name in names if getattr(self, name) != getattr(FrameSelection, name)]
