"""The layouts of data sets, patterns of paths or plain folders; opening a data set, whose layout is
recognised by its files."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, partial
from importlib import resources
from itertools import chain, islice
from pathlib import Path
from typing import Any

import yaml
from natsort import natsorted

from ..files import natural_key
from ..taxonomy import LabelSpace
from .camera_poses import read_cmu_list, read_fix, read_matrix, read_nvm, read_v2_poses
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
    shortened,
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
    """The layout of a data set on disk, an entry of ``layouts.yaml``.

    Attributes:
        origin: where the data set can be downloaded; empty for custom data.
        expected: description of the folders and files.
        images, labels: patterns of images, see `files_of`, and of label maps by label space;
            the first space on disk counts, or that which the user names. Without patterns of
            images each folder in a folder is a sequence, or the folder itself.
        signs: alternatives: patterns which all have files; by default each pattern alone.
        references, queries: texts in fields of references and of queries; without texts of
            queries all others are, and without both there are no roles.
        posed_by: what holds the poses, and where it is.
        truth, truth_files: the definition of a true match, or the names of files that have it, in
            the folder or beside it with the folder's name before their own.
    """

    name: str
    origin: str
    expected: str
    images: Sequence[str] = ()
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    signs: Sequence[Sequence[str]] = ()
    references: Sequence[str] = ()
    queries: Sequence[str] = ()
    posed_by: str = ""
    truth: Mapping[str, Any] = field(default_factory=dict)
    truth_files: Sequence[str] = ()

    def recognises(self, root: Path) -> bool:
        """Whether a folder has this layout."""
        if not self.images:
            return any(_of_folders(root))
        matches = partial(files_of, root, suffixes={*IMAGE_SUFFIXES, *LABEL_SUFFIXES})
        patterns = [*self.images, *chain.from_iterable(self.labels.values())]
        signs = self.signs or [[pattern] for pattern in patterns]
        return any(all(matches([pattern]) for pattern in sign) for sign in signs)

    def read(self, root: Path, labels_as: LabelsAs = None) -> Dataset:
        """The data set in a folder; ``labels_as`` is the label space that the user named. Damaged
        files of poses, and files of one name in a folder, are a ValueError that names them."""
        sequence = _SEQUENCES.get(self.name, joined)
        if self.images:
            images, labels = files_of(root, self.images, IMAGE_SUFFIXES, sequence), Files()
        else:
            images, labels = _of_folders(root)
        space = next(iter(self.labels), None)
        name = labels_as.name if isinstance(labels_as, LabelSpace) else labels_as
        for candidate in [name] if name in self.labels else self.labels:
            if labels := files_of(root, self.labels[str(candidate)], LABEL_SUFFIXES, sequence):
                space = candidate
                break
        files = labels | images
        poses = _POSES[self.name](root, files) if self.name in _POSES else {}
        fields = {sequence: of_file for (sequence, _), (_, of_file) in files.items()}
        roles = {sequence: self._role(of_file) for sequence, of_file in fields.items()}

        def place(key: Key) -> tuple[object, ...]:
            """By the first folder of which sequences have the name, then references first."""
            sequence, name = key
            first = next(iter(fields[sequence].values()))
            folder = first if sequence.startswith(first) else ""
            is_query = roles[sequence] != "reference"
            return natural_key(folder), is_query, natural_key(sequence), natural_key(name)

        frames = tuple(
            DatasetFrame(
                *key,
                images[key][0] if key in images else None,
                labels[key][0] if key in labels else None,
                poses.get(key, UNKNOWN),
                roles[key[0]],
            )
            for key in sorted(files, key=place)
        )
        notes = []
        if self.posed_by and not poses:
            notes = [f"no frame of {root} has a pose; expected {self.posed_by}"]
        return Dataset(self.name, root, frames, labels_as or space, self._truth(root), tuple(notes))

    def _role(self, fields: Fields) -> Role | None:
        texts = {text.lower() for name, text in fields.items() if name != "name"}
        if not texts.isdisjoint(self.references):
            return "reference"
        others = bool(self.references) and not self.queries
        return "query" if others or not texts.isdisjoint(self.queries) else None

    def _truth(self, root: Path) -> GroundTruth | None:
        folder = absolute_folder(root)
        for name in self.truth_files:
            for file in (root / name, folder.with_name(f"{folder.name}.{name}")):
                if file.is_file():
                    return GroundTruth(file)
        return GroundTruth(**self.truth) if self.truth else None


_ONLY_IMAGES = tuple(suffix for suffix in IMAGE_SUFFIXES if suffix not in LABEL_SUFFIXES)


def _of_folders(root: Path) -> tuple[Files, Files]:
    """The images and the label maps of the sequences that are folders in a folder, or of the one
    that it is, with the name and the path of the folder."""
    images, labels = Files(), Files()
    for folder in (root, *folders_in(root)):
        fields = {"sequence": absolute_folder(folder).name, "folder": str(folder)}
        for files, by_name in zip((images, labels), _frames(folder), strict=True):
            for name, path in by_name.items():
                files[fields["sequence"], name] = path, fields
        if folder is root and (images or labels):
            break
    return images, labels


def _frames(folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """The images and the label maps of a sequence."""
    if (folder / "images").is_dir() or (folder / "labels").is_dir():
        return images_in(folder / "images"), labels_in(folder / "labels")
    labels = {name: path for name, path in labels_in(folder).items() if "ground_truth" not in name}
    return labels | files_in(_ONLY_IMAGES, folder), labels


_CMU_NAME = re.compile(r"img_\d+_(c\d)_(\d{16})us(?:_rect)?")
_CAMVID_DRIVES = ("0001TP", "0006R0", "0016E5", "Seq05VD", "05VD")


def _cmu_sequence(fields: Fields) -> str | None:
    """One camera on one day (UTC): ``slice7-c0-2010-10-01``."""
    if not (parts := _CMU_NAME.fullmatch(fields["name"])):
        return None
    return f"{fields['slice']}-{parts[1]}-{datetime.fromtimestamp(int(parts[2]) / 1e6, UTC).date()}"


def _camvid_sequence(fields: Fields) -> str:
    """A drive, whose parts in splits are joined; of other frames the folder of the images."""
    drive = fields["name"].partition("_")[0]
    folder = fields.get("split", "701_StillsRaw_full")
    return fields.get("drive") or (drive if drive in _CAMVID_DRIVES else folder)


_SEQUENCES: dict[str, Callable[[Fields], str | None]] = {
    "extended-cmu": _cmu_sequence,
    "camvid": _camvid_sequence,
}
"""Of layouts whose sequences are not folders: by the fields of a file, ``None`` for no frame."""


def _cmu_poses(_root: Path, files: Files) -> dict[Key, Pose]:
    """Those of all references and half of the queries; ``_rect`` has the pose of its original."""
    listed = dict[tuple[Path, str], Pose]()
    for folder in {path.parents[1] for path, _ in files.values()}:
        lists = *folder.glob("ground-truth-database-*.txt"), *folder.glob("camera-poses/*.txt")
        listed |= {(folder, n): p for file in lists for n, p in read_cmu_list(file).items()}
    ids = {key: (path.parents[1], key[1].removesuffix("_rect")) for key, (path, _) in files.items()}
    return {key: listed[id_] for key, id_ in ids.items() if id_ in listed}


def _robotcar_poses(root: Path, files: Files) -> dict[Key, Pose]:
    """Those of the reference condition in the 3D models; of some queries in version 2."""
    listed = dict[str, Pose]()
    for model in sorted((root / "3D-models").rglob("*.nvm")):
        listed |= read_nvm(model)
    if (root / "robotcar_v2_train.txt").is_file():
        listed |= read_v2_poses(root / "robotcar_v2_train.txt")
    ids = {key: "/".join(fields.values()) for key, (_, fields) in files.items()}
    return {key: listed[id_] for key, id_ in ids.items() if id_ in listed}


def _table_poses(_root: Path, files: Files) -> dict[Key, Pose]:
    """Those of tables in the folders of the sequences or beside them."""
    table_of, poses = cache(PoseTable.of_folder), dict[Key, Pose]()
    for key, (path, fields) in files.items():
        folder = Path(fields["folder"])
        file = FrameFile(*key, path, folder=absolute(folder))
        if (table := table_of(folder)) and (pose := table.pose_of(file)):
            poses[key] = pose
    return poses


def _single_poses(
    pattern: str, read: Callable[[Path], Pose], root: Path, files: Files
) -> dict[Key, Pose]:
    """Poses of which each is in a file of its own."""
    there = files_of(root, [pattern], (".txt", ".json"))
    return {key: read(path) for key, (path, _) in there.items() if key in files}


_POSES: dict[str, Callable[[Path, Files], Mapping[Key, Pose]]] = {
    "folders": _table_poses,
    "extended-cmu": _cmu_poses,
    "robotcar-seasons": _robotcar_poses,
    "synthia": partial(
        _single_poses,
        "{series}/CameraParams/{stereo:Stereo_.*}/{camera:Omni_.*}/{name}",
        read_matrix,
    ),
    "cityscapes": partial(_single_poses, "vehicle/{split}/{city}/{name}_vehicle", read_fix),
}
"""Poses by the keys of the frames, of a folder and its files."""


@cache
def layouts() -> tuple[Layout, ...]:
    """The layouts in the order in which they are tried; plain folders, which accept most, last."""
    text = resources.files(__package__).joinpath("layouts.yaml").read_text("utf-8")
    entries = yaml.safe_load(text).items()
    return tuple(Layout(name, **entry) for name, entry in entries)


AUTO = "auto"
_MOST = 1000


def open_dataset(
    path: str | Path,
    layout: str | None = None,
    labels: str | Path | None = None,
    labels_as: LabelsAs = None,
) -> Dataset:
    """The data set in a folder, of a layout by name or the first that recognises it;
    with ``labels``, a folder, the label maps are those of `Dataset.with_labels`. ``labels_as`` is
    their label space, by default that of the layout. No folder, an unknown layout or one that does
    not fit, missing or damaged files, and ``labels`` without ``labels_as`` are a ValueError."""
    root = Path(path)
    if not root.is_dir():
        raise ValueError(f"{root} is no folder; expected the folder of a data set")
    if labels is not None and labels_as is None:
        raise ValueError(f"the label maps in {labels} need a label space")
    chosen = _layout_of(root, None if layout == AUTO else layout)
    dataset = chosen.read(root, labels_as)
    if not dataset.frames:
        raise ValueError(
            f"{root} ({chosen.name}) holds no frames: expected {chosen.expected}; the data set is "
            f"at {chosen.origin}"
        )
    if labels is not None and labels_as is not None:
        return dataset.with_labels(labels, labels_as)
    return dataset


def _layout_of(root: Path, name: str | None) -> Layout:
    """The layout of this name, or the first that recognises the folder; else a ValueError."""
    candidates = [layout for layout in layouts() if name in (None, layout.name)]
    if not candidates:
        names = ", ".join(layout.name for layout in layouts())
        raise ValueError(f"unknown layout {name!r}; expected one of {names}")
    for layout in candidates:
        if layout.recognises(root):
            return layout
    if name is None:
        expected = "; ".join(f"{layout.name}: {layout.expected}" for layout in candidates)
        raise ValueError(
            f"{root} is in no known layout; found {_content(root)}; expected one of {expected}"
        )
    origin = f"; the data set is at {candidates[0].origin}" if candidates[0].origin else ""
    raise ValueError(
        f"{root} is not in the layout {name}: expected {candidates[0].expected}; found "
        f"{_content(root)}{origin}"
    )


def _content(root: Path) -> str:
    """Names of the files and folders in a folder and in its folders, shortened."""
    inside = [
        f"{folder.name}/{entry.name}"
        for folder in folders_in(root)
        for entry in [*islice(folder.iterdir(), _MOST)] or [Path()]
    ]
    files = [entry.name for entry in islice(root.iterdir(), _MOST) if not entry.is_dir()]
    return shortened(natsorted(sorted(inside + files)))
