"""Layout: where a data set has its frames, as patterns of paths or as plain folders."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from ..files import natural_key
from ..taxonomy import LabelSpace
from .dataset import (
    Dataset,
    DatasetFrame,
    GroundTruth,
    LabelsAs,
    Role,
    files_in,
    folders_in,
    images_in,
    labels_in,
)
from .frame_file import FrameFile
from .label_files import SUFFIXES as LABEL_SUFFIXES
from .names import IMAGE_SUFFIXES, absolute, absolute_folder
from .pose_tables import PoseTable
from .poses import UNKNOWN, Pose

_FIELD = re.compile(r"\{(\w+)(?::([^{}]*))?\}")

Fields = dict[str, str]
Key = tuple[str, str]
"""The sequence and the name of a frame."""
Files = dict[Key, tuple[Path, Fields]]
"""The file of each frame, and the texts of the fields of its pattern."""


def joined(fields: Fields) -> str:
    """The sequence named by all fields of the path but the name of the frame."""
    return "-".join(text for name, text in fields.items() if name != "name")


def files_of(
    root: Path,
    patterns: Iterable[str],
    suffixes: Collection[str],
    sequence: Callable[[Fields], str | None] = joined,
) -> Files:
    """The files below a folder that fit patterns without suffixes, the first of each frame.

    In a pattern ``{city}`` is any text without a slash, ``{camera:left|rear}`` a regular
    expression, ``{name}`` the frame. A first folder that is a field fits this folder too. Two files
    of one name are a ValueError; those whose sequence is ``None`` are left out."""
    files: Files = {}
    for pattern in patterns:
        glob = _FIELD.sub("*", pattern) + ".*"
        first, _, below = glob.partition("/")
        expression = re.compile(_FIELD.sub(lambda m: f"(?P<{m[1]}>{m[2] or '[^/]+'})", pattern))
        matches = list[tuple[Path, Fields]]()
        if first == "*":
            matches = _matching(root, below, f"{absolute_folder(root).name}/", expression, suffixes)
        in_folder = dict[tuple[Path, str], Path]()
        for path, fields in matches or _matching(root, glob, "", expression, suffixes):
            other = in_folder.setdefault((path.parent, path.stem), path)
            if other != path:
                raise ValueError(f"one frame is both {other} and {path.name}")
            if (name := sequence(fields)) is not None:
                files.setdefault((name, fields["name"]), (path, fields))
    return files


def _matching(
    root: Path, glob: str, start: str, expression: re.Pattern[str], suffixes: Collection[str]
) -> list[tuple[Path, Fields]]:
    """The shown files of a glob whose place, after ``start``, has an expression, and its groups."""
    paths = (path for path in sorted(root.glob(glob)) if path.suffix.lower() in suffixes)
    places = ((path, start + str(path.relative_to(root).with_suffix(""))) for path in paths)
    return [
        (path, match.groupdict())
        for path, place in places
        if (match := expression.fullmatch(place)) and "/." not in f"/{place}" and not path.is_dir()
    ]


@dataclass(frozen=True)
class Layout:
    """The layout of a data set on disk.

    Attributes:
        origin: where the data set can be downloaded; empty for custom data.
        expected: description of the folders and files.
        images, labels: patterns of images, see `files_of`, and of label maps by label space;
            the first space on disk counts, or that which the user names.
        signs: alternatives: patterns which all have files; by default each pattern alone.
        sequence, role: by the fields of a file; the sequence is ``None`` for what is no frame.
        poses: poses by the keys of the frames, of which a folder and the files are given.
        posed_by: what holds the poses, and where it is.
        truth: the definition of a true match for a folder.
    """

    name: str
    origin: str
    expected: str
    images: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)
    signs: tuple[tuple[str, ...], ...] = ()
    sequence: Callable[[Fields], str | None] = joined
    role: Callable[[Fields], Role | None] = lambda fields: None
    poses: Callable[[Path, Files], Mapping[Key, Pose]] = lambda root, files: {}
    posed_by: str = ""
    truth: Callable[[Path], GroundTruth | None] = lambda root: None

    def recognises(self, root: Path) -> bool:
        """Whether a folder has this layout."""
        matches = partial(files_of, root, suffixes={*IMAGE_SUFFIXES, *LABEL_SUFFIXES})
        signs = self.signs or [(pattern,) for pattern in (*self.images, *self.labels)]
        return any(all(matches([pattern]) for pattern in patterns) for patterns in signs)

    def read(self, root: Path, labels_as: LabelsAs = None) -> Dataset:
        """The data set in a folder; ``labels_as`` is the label space that the user named. Damaged
        files of poses, and files of one name in a folder, are a ValueError that names them."""
        images = files_of(root, self.images, IMAGE_SUFFIXES, self.sequence)
        space, labels = self._labels(root, labels_as)
        files = labels | images
        poses = self.poses(root, files)
        fields = {sequence: of_file for (sequence, _), (_, of_file) in files.items()}

        def place(key: Key) -> tuple[object, ...]:
            """By the first folder of which sequences have the name, then references first."""
            sequence, name = key
            first = next(iter(fields[sequence].values()))
            folder = first if sequence.startswith(first) else ""
            is_query = self.role(fields[sequence]) != "reference"
            return natural_key(folder), is_query, natural_key(sequence), natural_key(name)

        frames = tuple(
            DatasetFrame(
                *key,
                images[key][0] if key in images else None,
                labels[key][0] if key in labels else None,
                poses.get(key, UNKNOWN),
                self.role(fields[key[0]]),
            )
            for key in sorted(files, key=place)
        )
        notes = []
        if self.posed_by and not poses:
            notes = [f"no frame of {root} has a pose; expected {self.posed_by}"]
        truth = self.truth(root)
        return Dataset(self.name, root, frames, labels_as or space, truth, tuple(notes))

    def _labels(self, root: Path, labels_as: LabelsAs) -> tuple[str | None, Files]:
        """The label space that the user named, or the first that has label maps, and these."""
        spaces = [*dict.fromkeys(self.labels.values())]
        name = labels_as.name if isinstance(labels_as, LabelSpace) else labels_as
        for space in [space for space in spaces if space == name] or spaces:
            patterns = [pattern for pattern, of in self.labels.items() if of == space]
            if files := files_of(root, patterns, LABEL_SUFFIXES, self.sequence):
                return space, files
        return next(iter(spaces), None), {}


_ROLES: dict[str, Role] = {
    "reference": "reference",
    "ref": "reference",
    "database": "reference",
    "query": "query",
    "queries": "query",
}
_TRUTHS = ("ground_truth.json", "ground_truth.csv", "ground_truth.npy")
_ONLY_IMAGES = tuple(suffix for suffix in IMAGE_SUFFIXES if suffix not in LABEL_SUFFIXES)


@dataclass(frozen=True)
class Folders(Layout):
    """A layout whose sequences are the folders in a folder, or the folder itself."""

    name: str = "folders"
    origin: str = ""
    expected: str = (
        "folders of label maps (.png, .npy, .tif, .bmp) or images (.jpg), one per sequence"
    )

    def recognises(self, root: Path) -> bool:
        """Whether a folder holds frames, or one in it."""
        return bool(_sequences(root))

    def read(self, root: Path, labels_as: LabelsAs = None) -> Dataset:
        """The sequences in a folder, or the sequence that it is."""
        truth = next((root / name for name in _TRUTHS if (root / name).is_file()), None)
        frames = list[DatasetFrame]()
        for folder in _sequences(root):
            sequence, place = absolute_folder(folder).name, absolute(folder)
            role = _ROLES.get(sequence.lower())
            images, labels = _frames(folder)
            files, table = labels | images, PoseTable.of_folder(folder)
            for name in sorted(files, key=natural_key):
                file = FrameFile(sequence, name, files[name], folder=place)
                pose = (table and table.pose_of(file)) or UNKNOWN
                paths = images.get(name), labels.get(name)
                frames.append(DatasetFrame(sequence, name, *paths, pose, role))
        file_of_truth = GroundTruth(truth) if truth else None
        return Dataset(self.name, root, tuple(frames), labels_as, file_of_truth)


def _sequences(root: Path) -> list[Path]:
    return [root] if any(_frames(root)) else [f for f in folders_in(root) if any(_frames(f))]


def _frames(folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """The images and the label maps of a sequence."""
    if (folder / "images").is_dir() or (folder / "labels").is_dir():
        return images_in(folder / "images"), labels_in(folder / "labels")
    labels = {name: path for name, path in labels_in(folder).items() if "ground_truth" not in name}
    return labels | files_in(_ONLY_IMAGES, folder), labels
