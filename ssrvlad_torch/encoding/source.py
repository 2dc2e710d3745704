"""Opening a selection of frames: first the network that labels them, then the frames."""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..database.database import Database
from ..database.rows import Origin
from ..datasets.dataset import Dataset, Kind
from ..datasets.frame_files import FrameFile, found_by
from ..datasets.image_files import find_image_files, read_image
from ..datasets.label_files import find_label_files, one_of_each_place, read_label_map
from ..datasets.layouts import open_dataset
from ..datasets.names import SequenceFolders
from ..datasets.poses import UNKNOWN, Pose, Projection
from ..segmentation.cache import known_key
from ..segmentation.networks import AUTO, open_network, runs_code
from ..segmentation.segmenter import Segmenter, space_of
from ..taxonomy import VOID, LabelSpace, label_space
from .plan import Plan
from .results import Note, Summary, do_nothing
from .selection import FrameSelection

_MUCH_VOID = 0.5
_OF_FILES = ("poses", "topic", "fps", "every", "start", "segmenter", "index_is_id")


@dataclass(frozen=True)
class SelectedFrames:
    """The frames of a selection, before the first is read.

    Attributes:
        selection: what the user said.
        labels_as: label space of the label maps; empty for images that are not labelled.
        files: the frames: label maps, or images with a segmenter.
        segmenter: labels images.
        database: holds the frames, in place of files.
        dataset: of which the frames are, with all its sequences.
        map_folders: folders whose sequences already have a name, see `sequence_names`.
    """

    selection: FrameSelection
    labels_as: str | LabelSpace = ""
    files: Sequence[FrameFile] = ()
    segmenter: Segmenter | None = None
    database: Database | None = None
    dataset: Dataset | None = None
    map_folders: SequenceFolders = ()

    @property
    def folders(self) -> SequenceFolders:
        """Of the sequences; none of a database whose sequence the user named."""
        if self.database is None:
            return {(file.folder, file.sequence) for file in self.files}
        return () if self.selection.sequence else self.database.folders()


def open_frames(
    selection: FrameSelection,
    database: Database | None = None,
    *,
    network: str | Segmenter | None = None,
    labels_as: str | LabelSpace | None = None,
    compared: bool = False,
    images: bool = False,
    live: bool = False,
    opened: Segmenter | None = None,
    note: Note = do_nothing,
) -> SelectedFrames:
    """The frames of a selection, before the first is read.

    Args:
        database: with which they are ``compared``, and where they may be a database themselves, or
            to which they are added.
        network, labels_as: used where the selection names neither.
        images: the frames can only be images.
        live: the names of the files come later, one by one.
        opened: the network of the database, if it was opened before.
        note: gets what a data set lacks, tables of poses that fit no frame, and the network that
            labels pictures if the user names none.

    Settings that do not go together, no frames or no label space, and a network of the database
    that cannot be opened or has changed are a ValueError."""
    if selection.segmenter or selection.labels_as:
        network, labels_as = selection.segmenter, selection.labels_as
    dataset, folders = None, () if database is None else database.folders()
    if selection.layout is not None:
        dataset = open_dataset(selection.paths[0], selection.layout, selection.labels, labels_as)
        for warning in dataset.select(selection.split or (), selection.role).warnings:
            note(warning)
    frames = SelectedFrames(selection, dataset=dataset, map_folders=folders)
    if compared and len(selection.paths) == 1 and Database.exists(path := selection.paths[0]):
        if unused := [f"--{name.replace('_', '-')}" for name in selection.changed(*_OF_FILES)]:
            raise ValueError(f"{path} is a database: expected no {', '.join(unused)}")
        labels_as = labels_as or _space_of_database(database, compared)
        return replace(frames, labels_as=labels_as or "", database=Database.open(path))
    projection = Projection(partial(pose_in, database))
    space, segmenter = _labelling(
        frames, database, network, labels_as, compared, images, opened,
        partial(found_by, _files_of, frames, projection, find_image_files), note,
    )  # fmt: skip
    frames = replace(frames, labels_as=space or "", segmenter=segmenter)
    if live:
        return frames
    find = find_image_files if images or segmenter else find_label_files
    if selection.index_is_id and find is find_image_files:
        raise ValueError("--index-is-id is for label maps, got images")
    try:
        files = _files_of(frames, projection, find, note)
    except ValueError:
        if dataset or segmenter or images or not _are_only_images(selection.paths):
            raise
        raise ValueError(
            f"{' '.join(selection.paths)} holds images and no label maps; name the network that "
            "labels them with --segmenter"
        ) from None
    if selection.index_is_id:
        files = [replace(file, index_is_id=True) for file in files]
    return replace(frames, files=files)


def up_to_date(
    selection: FrameSelection,
    database: Database | None,
    network: str | Segmenter | None,
    labels_as: str | LabelSpace | None,
    complete: bool,
    prune: bool,
) -> Summary | None:
    """What encoding images into a database gives where nothing is to be done, without opening the
    network; ``None`` where something is, or it cannot be told: the files of a network are known
    once it has been used."""
    if database is None or not isinstance(network, str) or selection.layout:
        return None
    key = known_key(network, cache_folder())
    origins = [o for o in database.used_origins() if o.label_space and o.segmenter == key]
    space = origins[0].label_space if key and len(origins) == 1 else None
    if space is None or (
        labels_as not in (None, AUTO) and label_space(labels_as).digest != space.digest
    ):
        return None
    frames = SelectedFrames(selection, map_folders=database.folders())
    files = _files_of(frames, Projection(partial(pose_in, database)), find_image_files)
    plan = Plan.of(files, database, origins[0])
    if plan.files or plan.refused or (prune and plan.gone):
        return None
    return Summary(already_there=plan.already_there, gone=plan.gone if complete else [])


def note_void(source: SelectedFrames, note: Note) -> None:
    """Notes a first label map that is mostly void: the label space may be wrong."""
    space = label_space(source.labels_as)
    void = [label.id for label in space.classes if label.category == VOID]
    for file in () if source.segmenter else source.files:
        with suppress(ValueError):
            share = float(np.isin(read_label_map(file, space), void).mean())
            if share > _MUCH_VOID:
                note(f"{file.location}: {share:.0%} is void in {space.name}; is --labels-as right?")
            return


def note_other_spaces(database: Database, used: LabelSpace, note: Note) -> None:
    """Notes which other label spaces a database holds."""
    spaces = [
        f"another {space.name}" if space.name == used.name else space.name
        for space in (database.label_spaces() if len(database.origins) > 1 else ())
        if space.digest != used.digest
    ]
    if spaces:
        note(f"{database.path} also holds frames of {' and '.join(spaces)}")


def _labelling(
    frames: SelectedFrames,
    database: Database | None,
    network: str | Segmenter | None,
    labels_as: str | LabelSpace | None,
    compared: bool,
    images: bool,
    opened: Segmenter | None,
    pictures: Callable[[], list[FrameFile]],
    note: Note,
) -> tuple[str | LabelSpace | None, Segmenter | None]:
    """The label space of the frames, ``None`` for images that are not labelled, and the network
    that labels them, ``None`` for label maps: by what the user says, else the network itself, the
    data set, or the database, whose network labels what are no label maps."""
    if isinstance(network, Segmenter):
        return network.label_space if labels_as in (None, AUTO) else labels_as, network
    selection, dataset = frames.selection, frames.dataset
    asked = None if labels_as == AUTO else labels_as
    named = open_network(network) if network else None
    if named and labels_as in (None, AUTO):
        has_names = labels_as or named.class_names or named.labels_as is not None
        labels_as = space_of(named) if has_names else None
    labels_as = labels_as or (dataset.labels_as if dataset else None)
    segmenter, maker = None, None if named else database
    if maker is not None and (images or (not labels_as and _are_of(maker, pictures))):
        origin = origin_of(maker)
        labels_as = asked or origin.label_space or label_space(maker.config.labels_as)
        if opened and not selection.changed("segmenter_cache"):
            segmenter = opened
        else:
            named = open_network(origin.network)
    if named and not labels_as and database is None:
        raise ValueError(f"{named.name} does not name its classes; give --labels-as")
    labels_as = labels_as or _space_of_database(database, compared)
    if labels_as is None and not images:
        raise ValueError(
            "expected the label space of the label maps, --labels-as, or a network for pictures, "
            "--segmenter, got none"
        )
    if named and labels_as is not None:
        cache = Path(selection.segmenter_cache) if selection.segmenter_cache else cache_folder()
        segmenter = Segmenter.load(named, labels_as, cache)
        if named.assumption:
            note(named.assumption)
    elif selection.segmenter_cache is not None:
        raise ValueError("--segmenter-cache needs --segmenter")
    if segmenter and maker is not None:
        require_network(maker, segmenter)
        note(f"{segmenter.name}, the network of {maker.path}, labels the pictures")
    return labels_as, segmenter


def cache_folder() -> Path:
    """Where label maps and features of pictures are kept, unless the user names a folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"


def origin_of(database: Database) -> Origin:
    """The network and the label space with which all frames of a database were labelled. No network
    or more than one, one without a name, and a name that runs code, which only a user may choose,
    are a ValueError."""
    origins = [origin for origin in database.used_origins() if origin.segmenter]
    if not origins:
        raise ValueError(
            f"{database.path} was not made from pictures; name a --segmenter, or query "
            "with label maps"
        )
    names = dict.fromkeys(origin.network or "a network without a name" for origin in origins)
    if len(origins) > 1 or not origins[0].network:
        raise ValueError(f"{database.path} was made by {', '.join(names)}; name the --segmenter")
    if runs_code(origins[0].network):
        raise ValueError(f"{database.path} was made by code: say --segmenter {origins[0].network}")
    network = Path(origins[0].network)  # stored as an absolute path, or of the hub
    if not str(network).startswith("hf:") and (not network.is_absolute() or ".." in network.parts):
        raise ValueError(f"{database.path} names its network {str(network)!r}, no absolute path")
    return origins[0]


def require_network(database: Database, segmenter: Segmenter) -> None:
    """Raises a ValueError if another network labelled frames of a database."""
    makers = {origin.segmenter: origin.network for origin in database.used_origins()}
    makers.pop("", None)
    if makers and makers.keys() != {segmenter.key()}:
        got = segmenter.name or "the given network"
        expected = ", ".join(name or "a network without a name" for name in makers.values())
        raise ValueError(
            f"{database.path} was made by {expected} as it was then; {got} gives other label maps "
            "(with another label space or other settings it is another network, and so is the ONNX "
            "file of a module: encode with the file to be deployed)"
        )


def _files_of(
    frames: SelectedFrames,
    projection: Projection,
    find: Callable[..., list[FrameFile]],
    note: Note = do_nothing,
) -> list[FrameFile]:
    """The frames that ``find`` finds, or those of the data set."""
    selection, dataset = frames.selection, frames.dataset
    if dataset:
        chosen, truth = dataset.select(selection.split or (), selection.role), dataset.truth
        by_poses = truth is not None and truth.metres is not None
        if selection.posed or (selection.posed is None and by_poses):
            chosen = chosen.posed()
        kind: Kind = "image" if find is find_image_files else "label"
        return chosen.files(kind, selection.every, selection.start)
    settings: dict[str, Any] = {
        "sequence": selection.sequence, "every": selection.every, "start": selection.start,
        "poses": selection.poses, "topic": selection.topic, "fps": selection.fps,
        "map_folders": frames.map_folders, "projection": projection, "note": note,
    }  # fmt: skip
    if find is find_label_files and frames.labels_as:
        settings["choose"] = partial(one_of_each_place, label_space(frames.labels_as), note=note)
    return find([*selection.paths], **settings)


def _are_only_images(paths: Sequence[str]) -> bool:
    has_labels = any(found_by(find_label_files, [path]) for path in paths)
    return not has_labels and bool(found_by(find_image_files, paths))


def pose_in(database: Database | None) -> Pose:
    """The first pose that a database has."""
    table = database.known().table if database else None
    rows = zip(*(table[name].to_pylist() for name in Pose._fields), strict=True) if table else ()
    return next((Pose(*row) for row in rows if not np.isnan(row[0])), UNKNOWN)


def _are_of(database: Database, pictures: Callable[[], list[FrameFile]]) -> bool:
    """Whether frames are pictures for the network of a database: the first that can be read is no
    label map of any of its label spaces."""
    spaces = [origin.label_space for origin in database.used_origins() if origin.segmenter]
    for file in pictures() if spaces else ():
        for space in filter(None, spaces):
            with suppress(ValueError):
                ids = np.unique(read_label_map(file, space)).tolist()
                if {*ids} <= {label.id for label in space.classes}:
                    return False
        with suppress(ValueError):
            read_image(file)
            return True
    return False


def _space_of_database(database: Database | None, compared: bool) -> LabelSpace | None:
    """The label space of all frames of a database, or where it has none of its settings, if frames
    are compared with it. Several are a ValueError."""
    if database is None:
        return None
    spaces = database.label_spaces()
    if len(spaces) > 1:
        names = " and ".join(space.name for space in spaces)
        raise ValueError(f"{database.path} holds frames of {names}; choose one with --labels-as")
    if compared and not spaces:
        return label_space(database.config.labels_as)
    return spaces[0] if spaces else None
