"""Which references show the place of each query, by the options of the user."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
import numpy.typing as npt
from natsort import natsorted

from ..database.frames import FrameSet
from ..datasets.dataset import Dataset, Frame
from ..datasets.dataset import GroundTruth as DatasetTruth
from ..datasets.frame_files import FrameFile
from ..datasets.names import KnownFolders
from ..evaluation.ground_truth import from_frame_numbers, from_poses
from ..evaluation.ground_truth_files import PartialTruth, from_file, unmatched_entries
from .options import TruthOptions
from .output import note


@dataclass(frozen=True)
class Places:
    """Frames, and where they were taken.

    Attributes:
        frames: ids.
        poses: ``(N, 3)`` float64, x and y in metres and heading in radians, NaN where unknown.
        counted: ids of these and of all other frames that count where frames are counted, in
            order: those that were skipped, and with a data set all that it has of the sequences.
        folders: of the sequences, where they are known.
    """

    frames: tuple[str, ...]
    poses: npt.NDArray[np.float64]
    counted: tuple[str, ...]
    folders: KnownFolders = ()

    @classmethod
    def of(cls, frames: Iterable[Frame | FrameFile], dataset: Dataset | None = None) -> Places:
        """The places of frames on disk, counted among all of the data set."""
        taken = list(frames)
        ids = tuple(frame.frame for frame in taken)
        poses = np.array([frame.pose for frame in taken], np.float64).reshape(-1, 3)
        folders = {(f.folder, f.sequence) for f in taken if isinstance(f, FrameFile)}
        return cls(ids, poses, _counted(ids, dataset), folders)

    @classmethod
    def of_set(
        cls,
        frames: FrameSet,
        dataset: Dataset | None,
        folders: KnownFolders,
        skipped: Iterable[str] = (),
    ) -> Places:
        """The places of encoded frames, counted together with the skipped ones."""
        ids = frames.frames
        return cls(ids, frames.poses, _counted([*ids, *skipped], dataset), folders)

    @property
    def paths(self) -> dict[str, str]:
        """The counted ids, each with the path of its file where its sequence is one folder."""
        several = Counter(sequence for _, sequence in self.folders)
        folder = {name: folder for folder, name in self.folders if folder and several[name] == 1}
        parts = ((frame, *frame.rpartition("/")[::2]) for frame in self.counted)
        return {
            frame: PurePath(folder[sequence], name).as_posix() if sequence in folder else frame
            for frame, sequence, name in parts
        }


@dataclass(frozen=True)
class TrueMatches:
    """What counts as a true match: a file, or a distance in metres or in frames."""

    file: Path | None
    metres: float | None
    degrees: float | None
    frames: int | None

    def __post_init__(self) -> None:
        given = sum(value is not None for value in (self.file, self.metres, self.frames))
        if given != 1:
            raise ValueError(
                "expected one of --ground-truth, --tolerance-metres and --tolerance-frames, "
                f"got {given} of them"
            )
        if self.degrees is not None and self.metres is None:
            raise ValueError("--tolerance-degrees wants --tolerance-metres beside it")

    @classmethod
    def by(cls, given: TruthOptions, said: DatasetTruth | None) -> TrueMatches:
        """By the options, or, if none of the three is given, by the data set."""
        own = (given.ground_truth, given.tolerance_metres, given.tolerance_frames)
        file, metres, frames = (
            own if own != (None,) * 3 or not said else (said.file, said.metres, said.frames)
        )
        return cls(file, metres, given.tolerance_degrees, frames)

    @property
    def words(self) -> str:
        """What counts as a true match, in words."""
        if self.file is not None:
            return str(self.file)
        if self.frames is not None:
            return f"at most {self.frames} frame{'s'[: self.frames != 1]} away"
        turned = "" if self.degrees is None else f" and {self.degrees:g} degrees"
        return f"within {self.metres:g} metres{turned}"

    def among(self, references: Places, queries: Places) -> PartialTruth:
        """The rows of the references that are true matches of each query; ``None`` where nothing is
        known. Notes how many such queries there are, and how many queries have the id of a
        reference."""
        truth = self._find(references, queries) if queries.frames else []
        unknown = sum(rows is None for rows in truth)
        if unknown:
            note(f"{unknown} of {len(truth)} queries are left out: {self.file} does not name them")
        themselves = len(set(queries.frames) & set(references.frames))
        if themselves:
            note(f"{themselves} of {len(queries.frames)} queries have ids of the database")
        return truth

    def _find(self, references: Places, queries: Places) -> PartialTruth:
        if self.metres is not None:
            return [*from_poses(queries.poses, references.poses, self.metres, self.degrees)]
        if self.file is not None:
            counted = from_file(self.file, queries.paths, references.paths)
            strange = unmatched_entries(self.file, queries.paths)
            if strange:
                note(
                    f"{len(strange)} of the queries that {self.file} names are not there, "
                    f"the first is {_in_order(strange)[0]}"
                )
        else:
            assert self.frames is not None
            counted = [*from_frame_numbers(queries.counted, references.counted, self.frames)]
        of_query = dict(zip(queries.counted, counted, strict=True))
        truth, missing = _rows([of_query[frame] for frame in queries.frames], references)
        if self.file and missing:
            note(
                f"{len(missing)} of the references that {self.file} names are not in the database, "
                f"the first is {_in_order(missing)[0]}"
            )
        return truth


def _counted(frames: Iterable[str], dataset: Dataset | None) -> tuple[str, ...]:
    """The ids that `Places` counts: the frames, and their sequences in the whole data set."""
    ids = {*frames}
    sequences = {frame.rpartition("/")[0] for frame in ids}
    if dataset:
        ids |= {frame.frame for frame in dataset.frames if frame.sequence in sequences}
    return tuple(_in_order(ids))


def _rows(truth: PartialTruth, references: Places) -> tuple[PartialTruth, Collection[str]]:
    """Turns places among the counted references into rows of the references; also gives the ids
    that are not among these."""
    row = {frame: number for number, frame in enumerate(references.frames)}
    rows = np.array([row.get(frame, -1) for frame in references.counted], np.int64)
    named = {place for places in truth if places is not None for place in places.tolist()}
    missing = {references.counted[place] for place in named if rows[place] < 0}
    there = [
        None if places is None else np.sort(rows[places][rows[places] >= 0]) for places in truth
    ]
    return there, missing


def _in_order(frames: Iterable[str]) -> list[str]:
    """By sequence, then by name, each in natural order."""
    return natsorted(sorted(frames), key=lambda frame: frame.rpartition("/")[::2])
