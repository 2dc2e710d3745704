"""The frames that a command works on, and what is known of them before the first is read."""

from collections.abc import Sequence
from dataclasses import dataclass

from ..database.database import Database
from ..database.metadata import Origin
from ..datasets.dataset import Dataset, GroundTruth
from ..datasets.frame_file import FrameFile
from ..datasets.names import KnownFolders
from ..segmentation.networks import runs_code
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


def origin_of(database: Database) -> Origin:
    """The network and the label space with which all frames of a database were labelled. No network
    or more than one, one without a name, and a name that runs code, which only a user may choose,
    are a ValueError."""
    origins = [origin for origin in database.origins.values() if origin.segmenter]
    if not origins:
        raise ValueError(f"{database.path} was not made from pictures; name a --segmenter")
    names = dict.fromkeys(origin.network or "a network without a name" for origin in origins)
    if len(origins) > 1 or not origins[0].network:
        raise ValueError(f"{database.path} was made by {', '.join(names)}; name the --segmenter")
    if runs_code(origins[0].network):
        raise ValueError(f"{database.path} was made by code: say --segmenter {origins[0].network}")
    return origins[0]


def require_network(database: Database, segmenter: Segmenter) -> None:
    """Raises a ValueError if another network labelled frames of a database."""
    others = {origin.segmenter: origin.network for origin in database.origins.values()}
    others.pop("", None)
    if others and others.keys() != {segmenter.key()}:
        got = segmenter.name or "the given network"
        expected = ", ".join(name or "a network without a name" for name in others.values())
        raise ValueError(
            f"{database.path} was made by {expected} as it was then; {got} gives other label maps "
            "(a module and its ONNX file are two networks: encode with the file to be deployed)"
        )
