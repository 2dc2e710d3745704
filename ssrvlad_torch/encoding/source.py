"""The frames that a command works on, and what is known of them before the first is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..database.database import Database
from ..datasets.dataset import Dataset, GroundTruth
from ..datasets.frame_file import FrameFile
from ..datasets.names import KnownFolders
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace


@dataclass(frozen=True)
class Source:
    """Frames on disk, or those of a database.

    Attributes:
        labels_as: label space of the label maps; empty for images that are not labelled.
        files: the frames: label maps, or images with a segmenter.
        segmenter: labels images.
        database: holds the frames, in place of files.
        sequence: name of their one sequence, if it is not that of the folder.
        dataset: of which the frames are, with all its sequences.
        truth: its ground truth.
        known: folders whose sequences already have a name, see `sequence_names`.
        workers: frames to encode at the same time; ``None`` for one for each core.
    """

    labels_as: str | LabelSpace = ""
    files: Sequence[FrameFile] = ()
    segmenter: Segmenter | None = None
    database: Database | None = None
    sequence: str | None = None
    dataset: Dataset | None = None
    truth: GroundTruth | None = None
    known: KnownFolders = ()
    workers: int | None = None
