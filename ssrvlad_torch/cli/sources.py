"""Frames of the SOURCE that the user typed: folders or a data set, label maps or images."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ..database.database import Database
from ..database.metadata import ExtraDescriptor
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile
from ..datasets.image_files import find_image_files, read_image
from ..datasets.label_files import find_label_files, read_label_map
from ..datasets.layouts import open_dataset
from ..datasets.names import KnownFolders
from ..encoding.extra_descriptors import extra_descriptors, problem_of_features
from ..localiser import origin_of, require_network
from ..segmentation.features import NAME as FEATURES
from ..segmentation.networks import AUTO, channels, open_network
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .options import SourceOptions
from .output import note

LabelsAs = str | os.PathLike[str] | LabelSpace


@dataclass(frozen=True)
class Source:
    """The source of frames.

    Attributes:
        options: of the user.
        dataset: the chosen part of the data set; ``None`` if the source is no data set.
        whole: the data set with all its sequences.
        labels_as: label space of the label maps, by the options, the segmenter or the data set.
        known: folders whose sequences already have a name, see `sequence_names`.
    """

    options: SourceOptions
    dataset: Dataset | None
    whole: Dataset | None
    labels_as: str | LabelSpace | None
    known: KnownFolders = ()

    @classmethod
    def open(cls, options: SourceOptions, known: KnownFolders = ()) -> Source:
        """Opens the source. If it is a data set, notes what the data set lacks."""
        whole = _open_dataset(options)
        dataset = whole and whole.select(options.split or (), options.role)
        for warning in dataset.warnings if dataset else ():
            note(warning)
        labels_as: str | LabelSpace | None = options.labels_as
        if options.segmenter and labels_as in (None, AUTO):
            required = labels_as == AUTO
            labels_as = _declared_space(options.segmenter, options.classes, required)
        labels_as = labels_as or (dataset.labels_as if dataset else None)
        return cls(options, dataset, whole, labels_as, known)

    def database(self) -> Database | None:
        """The database that the source is; ``None`` if it is none."""
        paths = self.options.paths
        return Database.open(paths[0]) if len(paths) == 1 and Database.exists(paths[0]) else None

    def with_network_of(self, database: Database | None, pictures: bool = False) -> Source:
        """The source with the network that made a database, if it is pictures and the user names
        no network and no label space; notes the network.

        Args:
            database: with which the frames are compared, if there is one.
            pictures: whether the source can only be pictures.

        Raises:
            ValueError: the network cannot be opened or has changed.
        """
        if database is None or self.options.segmenter or self.database():
            return self
        if not pictures and (self.labels_as or not self._holds_pictures(database)):
            return self
        origin = origin_of(database)
        options = dataclasses.replace(self.options, segmenter=origin.network)
        source = dataclasses.replace(self, options=options, labels_as=origin.label_space)
        segmenter = source.segmenter(origin.label_space or database.config.labels_as)
        assert segmenter
        require_network(database, segmenter)
        note(f"{origin.network}, the network of {database.path}, labels the pictures")
        return source

    def _holds_pictures(self, database: Database) -> bool:
        """Whether a network made the database, and the first frame that can be read is a picture:
        not all its pixels are ids, or colours, of the label space."""
        spaces = [o.label_space for o in database.origins.values() if o.segmenter]
        for file in try_find(self.image_files) if spaces else []:
            if any(reads(_known_ids, file, space) for space in spaces if space):
                return False
            if reads(read_image, file):
                return True
        return False

    def posed(self) -> Source:
        """The source without the frames of its data set that have no pose."""
        return dataclasses.replace(self, dataset=self.dataset and self.dataset.posed())

    def label_space(self, database: Database | None = None) -> str | LabelSpace:
        """The label space of the source, or else of the frames of a database.

        Raises:
            ValueError: it is not known.
        """
        labels_as = self.labels_as or (only_label_space(database) if database else None)
        if labels_as is None:
            raise ValueError("Missing option '--labels-as': label space of the label maps")
        return labels_as

    def frames(self, labels_as: LabelsAs) -> tuple[list[FrameFile], Segmenter | None]:
        """The frames. If they are images, also the segmenter that labels them."""
        segmenter = self.segmenter(labels_as)
        return self.image_files() if segmenter else self.label_files(), segmenter

    def segmenter(self, labels_as: LabelsAs) -> Segmenter | None:
        """The segmenter of the options, with its cache; ``None`` without ``--segmenter``."""
        network, folder = self.options.segmenter, self.options.segmenter_cache
        if network is None:
            if folder is not None:
                raise ValueError("--segmenter-cache needs --segmenter")
            return None
        classes, opened = channels(self.options.classes), _network(network)
        segmenter = Segmenter.load(opened, labels_as, folder or _user_cache(), classes)
        if opened.assumed:
            note(f"{network} does not say how it wants pictures; assumed: {opened.preparation}")
        return segmenter

    def extra_descriptors(
        self, names: Sequence[str] | None, segmenter: Segmenter | None, new: bool
    ) -> list[ExtraDescriptor]:
        """The descriptors of images that ``--with`` names; without, the default of a new database,
        with a note why a network has no features, and none of an existing one."""
        if names is None and not new:
            return []
        found = extra_descriptors(names, segmenter)
        if names is None and segmenter and FEATURES not in {each.name for each in found}:
            note(f"stored without features: {problem_of_features(segmenter)}")
        return found

    def check_with(self, names: Sequence[str] | None) -> None:
        """Refuses ``--with`` for label maps."""
        if names and not self.options.segmenter:
            raise ValueError(f"--with {names[0]} needs images as SOURCE and --segmenter")

    def label_files(self) -> list[FrameFile]:
        """The frames of a source of label maps."""
        options = self.options
        if self.dataset:
            return self.dataset.label_files(options.every, options.start)
        paths = options.paths
        try:
            return self._find(find_label_files)
        except ValueError:
            if not try_find(find_label_files, paths) and try_find(find_image_files, paths):
                raise ValueError(
                    f"{' '.join(paths)} holds images and no label maps; name the network that "
                    "labels them with --segmenter"
                ) from None
            raise

    def image_files(self) -> list[FrameFile]:
        """The frames of a source of images."""
        options = self.options
        if self.dataset:
            return self.dataset.image_files(options.every, options.start)
        return self._find(find_image_files)

    def _find(self, find: Callable[..., list[FrameFile]]) -> list[FrameFile]:
        options, names = self.options, ("sequence", "every", "start", "poses", "topic", "fps")
        chosen = {name: getattr(options, name) for name in (*names, "largest_gap")}
        return find(options.paths, known=self.known, **chosen)


def only_label_space(database: Database) -> LabelSpace | None:
    """The one label space of the frames of a database; ``None`` for an empty database.

    Raises:
        ValueError: the frames have several label spaces.
    """
    spaces = database.label_spaces()
    if len(spaces) > 1:
        names = " and ".join(space.name for space in spaces)
        raise ValueError(f"{database.path} holds frames of {names}; choose one with --labels-as")
    return spaces[0] if spaces else None


def reads(read: Callable[..., object], *arguments: object) -> bool:
    """Whether a function raises no ValueError."""
    with suppress(ValueError):
        read(*arguments)
        return True
    return False


def _known_ids(file: FrameFile, space: LabelSpace) -> None:
    """Raises a ValueError unless a frame is a label map in a label space."""
    ids = np.unique(read_label_map(file, space))
    if unknown := {*ids.tolist()} - {each.id for each in space.classes}:
        raise ValueError(f"{space.name} has no ids {unknown}")


def try_find(find: Callable[..., list[FrameFile]], *arguments: object) -> list[FrameFile]:
    """The files that ``find`` finds; none where it raises a ValueError."""
    with suppress(ValueError):
        return find(*arguments)
    return []


def _open_dataset(options: SourceOptions) -> Dataset | None:
    if options.layout and (options.poses or options.topic or options.fps):
        raise ValueError("--poses, --topic and --fps do not go with --layout")
    if options.largest_gap is not None and not options.poses:
        raise ValueError("--largest-gap needs --poses")
    if options.layout is None:
        if options.split or options.role or options.labels:
            raise ValueError("--split, --role and --labels need --layout, such as --layout auto")
        return None
    if len(options.paths) != 1:
        raise ValueError(
            f"--layout: expected the folder of one data set, got {len(options.paths)} sources"
        )
    name = None if options.layout == "auto" else options.layout
    return open_dataset(options.paths[0], name, options.labels, options.labels_as)


_network = cache(open_network)


def _declared_space(name: str, classes: str | None, required: bool) -> LabelSpace | None:
    """The label space that a network declares. If it declares none, a ValueError if it is required,
    else ``None``."""
    network = _network(name)
    if not network.class_names and network.labels_as is None and not required:
        return None
    return Segmenter.load(network, classes=channels(classes)).label_space


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"
