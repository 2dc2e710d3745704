"""Source: the frames that a user means: folders, a data set or a database; maps or images."""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..database.database import Database
from ..database.metadata import Origin
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile, found_by
from ..datasets.image_files import find_image_files, read_image
from ..datasets.label_files import find_label_files, read_label_map
from ..datasets.layouts import open_dataset
from ..datasets.names import KnownFolders
from ..segmentation.networks import ACCEPT, AUTO, NamedNetwork, open_network, runs_code
from ..segmentation.preparation import channels
from ..segmentation.segmenter import Segmenter, space_of
from ..taxonomy import LabelSpace, label_space
from .results import Note, do_nothing

_OF_FILES = ("poses", "largest_gap", "topic", "fps", "every", "start", "segmenter", "classes")


@dataclass(frozen=True)
class Wanted:
    """Which frames are wanted, as a user says it; ``ssrvlad encode --help`` explains every field.

    Attributes:
        posed: leave out frames of a data set without a pose; ``None``: if its ground truth is by
            poses.
    """

    paths: Sequence[str]
    labels_as: str | LabelSpace | None = None
    layout: str | None = None
    split: Sequence[str] | None = None
    role: Literal["reference", "query"] | None = None
    labels: Path | None = None
    sequence: str | None = None
    poses: str | None = None
    largest_gap: float | None = None
    topic: str | None = None
    fps: float | None = None
    every: int = 1
    start: int = 0
    segmenter: str | Segmenter | None = None
    classes: str | None = None
    segmenter_cache: Path | None = None
    workers: int | None = None
    posed: bool | None = False

    def given(self, *names: str) -> list[str]:
        """Those of these fields that are not at their defaults."""
        return [name for name in names if getattr(self, name) != getattr(Wanted, name)]


@dataclass(frozen=True)
class Source:
    """Frames on disk, or those of a database, and what is known before the first is read.

    Attributes:
        wanted: what the user said.
        labels_as: label space of the label maps; empty for images that are not labelled.
        files: the frames: label maps, or images with a segmenter.
        segmenter: labels images.
        database: holds the frames, in place of files.
        dataset: of which the frames are, with all its sequences.
        known: folders whose sequences already have a name, see `sequence_names`.
    """

    wanted: Wanted
    labels_as: str | LabelSpace = ""
    files: Sequence[FrameFile] = ()
    segmenter: Segmenter | None = None
    database: Database | None = None
    dataset: Dataset | None = None
    known: KnownFolders = ()


def open_source(
    wanted: Wanted,
    database: Database | None = None,
    *,
    compared: bool = False,
    images: bool = False,
    live: bool = False,
    opened: Segmenter | None = None,
    note: Note = do_nothing,
) -> Source:
    """The source, before its first frame is read.

    Args:
        wanted: which frames.
        database: with which they are ``compared``, and where they may be a database themselves, or
            to which they are added.
        images: the frames can only be images.
        live: the names of the files come later, one by one.
        opened: the network of the database, if it was opened before.
        note: gets what a data set lacks, and the network that labels pictures if the user names
            none.

    Raises:
        ValueError: settings do not go together, there are no frames or no label space, or the
            network of the database cannot be opened or has changed.
    """
    paths, dataset = wanted.paths, _open_dataset(wanted, note)
    source = Source(wanted, dataset=dataset, known=database.folders() if database else ())
    network: str | Segmenter | NamedNetwork | None = wanted.segmenter
    labels_as = wanted.labels_as
    if network and labels_as in (None, AUTO):
        network = open_network(network) if isinstance(network, str) else network
        labels_as = _space_of_network(network, labels_as, wanted.classes)
    labels_as = labels_as or (dataset.labels_as if dataset else None)
    if compared and len(paths) == 1 and Database.exists(paths[0]):
        if unused := [f"--{name.replace('_', '-')}" for name in wanted.given(*_OF_FILES)]:
            raise ValueError(f"{paths[0]} is a database: expected no {', '.join(unused)}")
        space = _space(labels_as, database, compared, images)
        return replace(source, labels_as=space, database=Database.open(paths[0]))
    if database and not network and (images or not labels_as):
        network, labels_as = _network_of_database(source, database, labels_as, images)
        if network and not wanted.given("segmenter_cache", "classes"):
            network = opened or network
    if network and not labels_as and not database:
        name = network if isinstance(network, str) else network.name
        raise ValueError(f"{name} does not name its classes; give --labels-as")
    space = _space(labels_as, database, compared, images)
    segmenter = _segmenter(network, wanted, space, note) if space else None
    if segmenter and database and not wanted.segmenter:
        require_network(database, segmenter)
        note(f"{segmenter.name}, the network of {database.path}, labels the pictures")
    source = replace(source, labels_as=space, segmenter=segmenter)
    if live:
        return source
    find = find_image_files if images or source.segmenter else find_label_files
    try:
        return replace(source, files=_find(wanted, dataset, source.known, find))
    except ValueError:
        only_images = (
            not (dataset or source.segmenter or images)
            and not any(found_by(find_label_files, [path]) for path in paths)
            and found_by(find_image_files, paths)
        )
        if only_images:
            raise ValueError(
                f"{' '.join(paths)} holds images and no label maps; name the network that "
                "labels them with --segmenter"
            ) from None
        raise


def cache_folder() -> Path:
    """Where label maps and features of pictures are kept, unless the user names a folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"


def origin_of(database: Database) -> Origin:
    """The network and the label space with which all frames of a database were labelled. No network
    or more than one, one without a name, and a name that runs code, which only a user may choose,
    are a ValueError."""
    origins = [origin for origin in database.origins.values() if origin.segmenter]
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
            "(with another label space or other settings it is another network, and so is the ONNX "
            "file of a module: encode with the file to be deployed)"
        )


def _open_dataset(wanted: Wanted, note: Note) -> Dataset | None:
    """The data set, of the wanted split, role and poses; none without a layout."""
    if wanted.layout and wanted.given("sequence", "poses", "topic", "fps"):
        raise ValueError("--sequence, --poses, --topic and --fps do not go with --layout")
    if wanted.largest_gap is not None and not wanted.poses:
        raise ValueError("--largest-gap needs --poses")
    if wanted.layout is None:
        if wanted.split or wanted.role or wanted.labels:
            raise ValueError("--split, --role and --labels need --layout, such as --layout auto")
        return None
    if len(wanted.paths) != 1:
        raise ValueError(
            f"--layout: expected the folder of one data set, got {len(wanted.paths)} sources"
        )
    whole = open_dataset(wanted.paths[0], wanted.layout, wanted.labels, wanted.labels_as)
    for warning in whole.select(wanted.split or (), wanted.role).warnings:
        note(warning)
    return whole


def _space_of_network(
    network: Segmenter | NamedNetwork, labels_as: str | LabelSpace | None, classes: str | None
) -> LabelSpace | None:
    """The label space that a network names, if it names one."""
    if isinstance(network, Segmenter):
        return network.label_space
    if labels_as or network.class_names or network.labels_as is not None:
        return space_of(network, AUTO, channels(classes))
    return None


def _network_of_database(
    source: Source, database: Database, labels_as: str | LabelSpace | None, images: bool
) -> tuple[str | None, str | LabelSpace | None]:
    """The name and the label space of the network that labelled the frames of a database, if the
    source holds pictures."""
    spaces = [origin.label_space for origin in database.origins.values() if origin.segmenter]
    if not images:
        where = source.wanted, source.dataset, source.known
        if not (spaces and _are_pictures(found_by(_find, *where, find_image_files), spaces)):
            return None, labels_as
    origin = origin_of(database)
    return origin.network, origin.label_space or label_space(database.config.labels_as)


def _find(
    wanted: Wanted,
    dataset: Dataset | None,
    known: KnownFolders,
    find: Callable[..., list[FrameFile]],
) -> list[FrameFile]:
    """The frames that ``find`` finds, or those of the data set."""
    if dataset:
        chosen, truth = dataset.select(wanted.split or (), wanted.role), dataset.truth
        if wanted.posed or (wanted.posed is None and truth and truth.metres is not None):
            chosen = chosen.posed()
        of = chosen.image_files if find is find_image_files else chosen.label_files
        return of(wanted.every, wanted.start)
    names = ("sequence", "every", "start", "poses", "topic", "fps", "largest_gap")
    settings = {name: getattr(wanted, name) for name in names}
    return find([*wanted.paths], known=known, **settings)


def _are_pictures(files: Sequence[FrameFile], spaces: Sequence[LabelSpace | None]) -> bool:
    """Whether the first file that can be read is no label map of any of the label spaces."""
    for file in files:
        for space in filter(None, spaces):
            with suppress(ValueError):
                ids = np.unique(read_label_map(file, space)).tolist()
                if {*ids} <= {label.id for label in space.classes}:
                    return False
        with suppress(ValueError):
            read_image(file)
            return True
    return False


def _space(
    labels_as: str | LabelSpace | None, database: Database | None, compared: bool, images: bool
) -> str | LabelSpace:
    """The label space of the source, or else of a database; empty for images alone."""
    if database and not labels_as:
        spaces = database.label_spaces()
        if len(spaces) > 1:
            names = " and ".join(space.name for space in spaces)
            raise ValueError(
                f"{database.path} holds frames of {names}; choose one with --labels-as"
            )
        labels_as = spaces[0] if spaces else None
    if labels_as is None and compared and database:
        return label_space(database.config.labels_as)
    if labels_as is None and not images:
        raise ValueError("expected the label space of the label maps, --labels-as, got none")
    return labels_as or ""


def _segmenter(
    network: str | Segmenter | NamedNetwork | None,
    wanted: Wanted,
    labels_as: str | LabelSpace,
    note: Note,
) -> Segmenter | None:
    """The segmenter with its cache; ``None`` without a network."""
    folder = wanted.segmenter_cache
    if network is None:
        if folder is not None:
            raise ValueError("--segmenter-cache needs --segmenter")
        return None
    opened = open_network(network) if isinstance(network, str) else network
    if isinstance(opened, Segmenter):
        return opened
    folder = folder or cache_folder()
    segmenter = Segmenter.load(opened, labels_as, folder, channels(wanted.classes))
    if opened.assumed:
        note(
            f"{opened.name} does not say how it wants pictures; assumed: {opened.preparation} "
            f"({ACCEPT}: true in a YAML file accepts that)"
        )
    return segmenter
