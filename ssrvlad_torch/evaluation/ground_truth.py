"""Ground truth from poses or frame numbers: rows of the references that show a query's place, by
distances or by a file; a query may have any number of true matches, also none."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
import numpy.typing as npt

from ..database.frames import FrameSet
from ..datasets.dataset import Dataset, DatasetFrame, GroundTruth
from ..datasets.frame_files import FrameFile
from ..datasets.names import SequenceFolders, name_of, sequence_of, split_id
from ..files import natural_key
from .curves import Rows
from .ground_truth_files import PartialTruth, from_file


@dataclass(frozen=True)
class Viewpoints:
    """Frames by their ids, and where they were taken.

    Attributes:
        poses: ``(N, 3)`` float64, x and y in metres and heading in radians, NaN where unknown.
        counted: ids of all frames that a ground truth or a tolerance in frames counts, in order:
            these, the skipped ones, and all that the data set has of their sequences.
        folders: of the sequences, if they are known.
    """

    frames: tuple[str, ...]
    poses: npt.NDArray[np.float64]
    counted: tuple[str, ...]
    folders: SequenceFolders = ()

    @classmethod
    def of(
        cls, frames: Iterable[DatasetFrame | FrameFile], dataset: Dataset | None = None
    ) -> Viewpoints:
        """The places of frames on disk, counted among all frames of the data set."""
        frames = list(frames)
        ids = tuple(frame.frame for frame in frames)
        poses = np.array([frame.pose for frame in frames], np.float64).reshape(-1, 3)
        folders = {(f.folder, f.sequence) for f in frames if isinstance(f, FrameFile)}
        return cls(ids, poses, _counted(ids, dataset), folders)

    @classmethod
    def of_set(
        cls,
        encoded: FrameSet,
        dataset: Dataset | None,
        folders: SequenceFolders,
        skipped: Iterable[str] = (),
    ) -> Viewpoints:
        """The places of encoded frames, counted together with the skipped ones."""
        counted = _counted([*encoded.frames, *skipped], dataset)
        return cls(encoded.frames, encoded.poses, counted, folders)

    @property
    def paths(self) -> dict[str, str]:
        """The file path of each counted id whose sequence is one folder, else the id."""
        count = Counter(sequence for _, sequence in self.folders)
        folder = {name: folder for folder, name in self.folders if folder and count[name] == 1}
        parts = ((frame, *split_id(frame)) for frame in self.counted)
        return {
            frame: PurePath(folder[sequence], name).as_posix() if sequence in folder else frame
            for frame, sequence, name in parts
        }


def true_matches(
    definition: GroundTruth,
    references: Viewpoints,
    queries: Viewpoints,
    note: Callable[[str], object],
) -> PartialTruth:
    """The rows of the references that are true matches of each query; ``None`` if they are not
    known. ``note`` gets the number of these queries, of queries with the id of a reference, and of
    names in the file that are not there."""
    truth = _matches(definition, references, queries, note) if queries.frames else []
    unknown = sum(rows is None for rows in truth)
    if unknown:
        reason = "their pose is unknown"
        if definition.file:
            reason = f"{definition.file} does not name them"
        note(f"{unknown} of {len(truth)} queries are left out: {reason}")
    common = len(set(queries.frames) & set(references.frames))
    if common:
        note(f"{common} of {len(queries.frames)} queries have ids of the database")
    return truth


def _matches(
    definition: GroundTruth,
    references: Viewpoints,
    queries: Viewpoints,
    note: Callable[[str], object],
) -> PartialTruth:
    if definition.metres is not None:
        limits = definition.metres, definition.degrees
        return from_poses(queries.poses, references.poses, *limits)
    if definition.file is not None:
        counted, unmatched = from_file(definition.file, queries.paths, references.paths)
        if unmatched:
            note(
                f"{len(unmatched)} queries of {definition.file} do not exist, "
                f"the first is {_in_order(unmatched)[0]}"
            )
    else:
        assert definition.frames is not None
        counted = [*from_frame_numbers(queries.counted, references.counted, definition.frames)]
    of_query = dict(zip(queries.counted, counted, strict=True))
    row = {frame: number for number, frame in enumerate(references.frames)}
    rows = np.array([row.get(frame, -1) for frame in references.counted], np.int64)
    truth: PartialTruth = []
    missing = set[str]()
    for positions in map(of_query.__getitem__, queries.frames):
        if positions is None:
            truth.append(None)
            continue
        matches = rows[positions]
        truth.append(np.sort(matches[matches >= 0]))
        missing |= {references.counted[at] for at in positions[matches < 0].tolist()}
    if definition.file and missing:
        note(
            f"{len(missing)} references of {definition.file} are not in the database, "
            f"the first is {_in_order(missing)[0]}"
        )
    return truth


def _counted(frames: Iterable[str], dataset: Dataset | None) -> tuple[str, ...]:
    """`Viewpoints.counted` of some frames."""
    ids = {*frames}
    sequences = {sequence_of(frame) for frame in ids}
    if dataset:
        ids |= {frame.frame for frame in dataset.frames if frame.sequence in sequences}
    return tuple(_in_order(ids))


def _in_order(frames: Iterable[str]) -> list[str]:
    """The ids by sequence, then by name, both in natural order."""
    return sorted(frames, key=lambda frame: tuple(map(natural_key, split_id(frame))))


_ROUNDING = 1e-9


def from_poses(
    queries: npt.NDArray[np.float64],
    references: npt.NDArray[np.float64],
    metres: float,
    degrees: float | None = None,
) -> list[Rows | None]:
    """True matches of each query: the references within a distance in metres, limit included, and
    perhaps in degrees of heading. Poses are ``(N, 2+)``, x, y, heading in radians; ``None`` for a
    query of unknown pose. A limit out of range, and no pose at all, are a ValueError."""
    check_distance(metres)
    if degrees is not None and not degrees >= 0:
        raise ValueError(f"the tolerance must be 0 degrees or more, got {degrees}")
    by_heading = degrees is not None
    posed = require_poses("queries", queries, by_heading)
    require_poses("references", references, by_heading)
    limit = math.inf if degrees is None else math.radians(degrees) + _ROUNDING
    truth: list[Rows | None] = []
    for query, is_posed in zip(queries, posed, strict=True):
        rows = np.flatnonzero(np.hypot(*(references[:, :2] - query[:2]).T) <= metres)
        if by_heading:
            turn = (references[rows, 2] - query[2] + math.pi) % math.tau - math.pi
            rows = rows[np.abs(turn) <= limit]
        truth.append(rows if is_posed else None)
    return truth


def check_distance(metres: float) -> None:
    """Raises a ValueError for a tolerance that is negative, infinite or NaN."""
    if not 0 <= metres < math.inf:
        raise ValueError(f"the tolerance must be 0 metres or more and finite, got {metres}")


def require_poses(
    name: str, poses: npt.NDArray[np.float64], by_heading: bool = False
) -> npt.NDArray[np.bool_]:
    """``(N,)`` bool, which poses are known, with their headings if these count; a ValueError with
    the name of the frames if none is."""
    posed = np.zeros(len(poses), bool)
    if poses.shape[1] >= 2 + by_heading:
        posed = ~np.any(np.isnan(poses[:, : 2 + by_heading]), axis=1)
    if len(posed) and not posed.any():
        kind, unit = ("heading", "degrees") if by_heading else ("pose", "metres")
        raise ValueError(
            f"none of {len(posed)} {name} has a {kind}; a tolerance in {unit} requires a poses.csv "
            "(frame,x,y,heading) with their names, in or beside their folder"
        )
    return posed


def from_frame_numbers(
    queries: Sequence[str], references: Sequence[str], frames: int
) -> list[Rows]:
    """True matches of each query: the references at most ``frames`` frames away in the sequence, by
    the order of names. If the queries' sequences are not among the references', both must be one
    sequence of equal length. Others, and a negative number, are a ValueError."""
    if frames < 0:
        raise ValueError(f"the tolerance must be 0 frames or more, got {frames}")
    of_queries, of_references = (
        {sequence_of(frame) for frame in ids} for ids in (queries, references)
    )
    shared = of_queries <= of_references
    if shared:
        query_numbers = reference_numbers = _numbers({*queries, *references})
    elif len(of_queries) == len(of_references) == 1:
        query_numbers, reference_numbers = _numbers({*queries}), _numbers({*references})
        if len(query_numbers) != len(reference_numbers):
            raise ValueError(
                "a tolerance in frames requires two sequences of equal length, got "
                f"{len(query_numbers)} query frames and {len(reference_numbers)} reference frames"
            )
    else:
        unknown = min(of_queries - of_references)
        raise ValueError(
            f"a tolerance in frames cannot align query sequence {unknown!r}: it is none of the "
            f"database's ({', '.join(sorted(of_references))}), and there is more than one"
        )
    sequences = np.array([reference_numbers[frame][0] for frame in references])
    numbers = np.array([reference_numbers[frame][1] for frame in references], np.int64)
    return [
        np.flatnonzero(
            ((sequences == sequence) | (not shared)) & (np.abs(numbers - number) <= frames)
        )
        for sequence, number in (query_numbers[frame] for frame in queries)
    ]


def _numbers(frames: Iterable[str]) -> dict[str, tuple[str, int]]:
    """Sequence of each frame, and its number in the sequence."""
    counts, numbers = Counter[str](), {}
    for frame in sorted(frames, key=lambda frame: natural_key(name_of(frame))):
        sequence = sequence_of(frame)
        numbers[frame] = sequence, counts[sequence]
        counts[sequence] += 1
    return numbers
