"""From what the user typed to frames: folders or a data set, label maps or images to segment."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ..config import SSRVLADConfig
from ..database.database import Database
from ..database.frames import FrameSet
from ..database.metadata import ExtraDescriptor
from ..database.reading import Damage
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile
from ..datasets.image_files import find_image_files
from ..datasets.label_files import find_label_files
from ..datasets.layouts import open_dataset
from ..datasets.names import KnownFolders, check_sequences
from ..descriptor import query_head
from ..encoding.encoder import encode_to_memory
from ..encoding.extra_descriptors import extra_descriptor
from ..encoding.results import Skipped
from ..recognition.follow import runs
from ..recognition.matching import frames_within, temporal_sum
from ..segmentation.networks import AUTO, channels, open_network
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .options import Reach, SourceOptions
from .output import note, progress_bar

LabelsAs = str | os.PathLike[str] | LabelSpace


@dataclass(frozen=True)
class Source:
    """The source of frames.

    Attributes:
        given: the options of the user.
        dataset: the chosen part of the data set, if it is one.
        whole: the data set with all its sequences.
        labels_as: label space of the label maps, as given or as the data set declares it.
        known: folders that have a name already, those of the database, see `sequence_names`.
    """

    given: SourceOptions
    dataset: Dataset | None
    whole: Dataset | None
    labels_as: str | LabelSpace | None
    known: KnownFolders = ()

    @classmethod
    def open(cls, given: SourceOptions, known: KnownFolders = ()) -> Source:
        """Opens the data set, if it is one, and notes what it lacks."""
        whole = _open_dataset(given)
        dataset = whole and whole.select(given.split or (), given.role)
        for warning in dataset.warnings if dataset else ():
            note(warning)
        labels_as: str | LabelSpace | None = given.labels_as
        if given.segmenter and labels_as in (None, AUTO):
            labels_as = _own_space(given.segmenter, given.classes, required=labels_as == AUTO)
        labels_as = labels_as or (dataset.labels_as if dataset else None)
        return cls(given, dataset, whole, labels_as, known)

    def database(self) -> Database | None:
        """The database that the source is, if it is one."""
        paths = self.given.paths
        return Database.open(paths[0]) if len(paths) == 1 and Database.exists(paths[0]) else None

    def posed(self) -> Source:
        """The same; of a data set, only the frames with a pose."""
        return dataclasses.replace(self, dataset=self.dataset and self.dataset.posed())

    def frames(self, labels_as: LabelsAs) -> tuple[list[FrameFile], Segmenter | None]:
        """The frames, and what makes label maps of them if they are images."""
        segmenter = self.segmenter(labels_as)
        return self.image_files() if segmenter else self.label_files(), segmenter

    def segmenter(self, labels_as: LabelsAs) -> Segmenter | None:
        """What makes label maps of images, if one was given."""
        network, folder = self.given.segmenter, self.given.segmenter_cache
        if network is None:
            if folder is not None:
                raise ValueError("--segmenter-cache wants a --segmenter")
            return None
        classes = channels(self.given.classes)
        return Segmenter.load(_network(network), labels_as, folder or _user_cache(), classes)

    def described_by(self, name: str | None) -> list[ExtraDescriptor]:
        """What else describes the images, if a method is named."""
        if name and not self.given.segmenter:
            raise ValueError(f"--with {name} wants images as SOURCE, and a --segmenter")
        return [extra_descriptor(name)] if name else []

    def label_files(self) -> list[FrameFile]:
        """The frames that are label maps."""
        given = self.given
        if self.dataset:
            return self.dataset.label_files(given.every, given.start)
        try:
            return find_label_files(
                given.paths, given.sequence, given.every, given.start, self.known, given.poses
            )
        except ValueError:
            if not attempt(find_label_files, given.paths) and attempt(
                find_image_files, given.paths
            ):
                raise ValueError(
                    f"{' '.join(given.paths)} holds images and no label maps; name the network "
                    "that labels them with --segmenter"
                ) from None
            raise

    def image_files(self) -> list[FrameFile]:
        """The frames that are images."""
        given = self.given
        if self.dataset:
            return self.dataset.image_files(given.every, given.start)
        return find_image_files(
            given.paths,
            given.sequence,
            given.every,
            given.start,
            self.known,
            given.poses,
            given.topic,
        )


def load_references(
    database: Database, reach: Reach, damage: list[Damage] | None = None
) -> tuple[FrameSet, int | dict[str, int]]:
    """The frames of a database, summed over time if asked for, and t of Eq. 3. A reach in metres
    gives each sequence a t of its own. For ``damage`` see `Database.load`."""
    frames = database.load(damage)
    if not frames.frames:
        raise ValueError(f"{database.path} holds no frames yet")
    if not reach:
        return frames, 0
    ts = dict.fromkeys(frames.sequences, reach.frames)
    if reach.metres is not None:
        ts = frames_within(frames.poses, frames.sequences, reach.metres)
    for run in runs(frames.sequences):
        names = frames.sequences[run.start : run.stop]
        for values in (frames.descriptors, *frames.beside.values()):
            rows = values[run.start : run.stop]
            temporal_sum(rows, names, ts[names[0]], out=rows)
    return frames, reach.frames if reach.metres is None else ts


def encode_queries(
    database: Database,
    source: Source,
    columns: Sequence[int] = (),
    beside: Sequence[ExtraDescriptor] = (),
) -> tuple[FrameSet, list[Skipped], KnownFolders]:
    """The frames of a source, encoded with the settings of a database, the skipped ones, and the
    folders of their sequences. A source that is a database gives its own frames.

    Args:
        database: whose settings are used.
        source: the frames.
        columns: anchors of a sweep, for descriptors ``(Q, S, 480)``; without, single ones.
            Databases and ``paper`` give single ones always.
        beside: the further methods that describe the images.
    """
    no_pictures = ValueError(
        f"{database.path} holds descriptors of pictures; expected images and a --segmenter, or "
        "--no-fuse"
    )
    if other := source.database():
        if other.fingerprint != database.fingerprint:
            raise ValueError(
                f"{other.path} has fingerprint {other.fingerprint or 'none'}, {database.path} has "
                f"{database.fingerprint or 'none'}: they do not compare"
            )
        frames = other.load()
        if not set(beside) <= set(other.beside):
            raise no_pictures
        known = {one.name: frames.beside[one.name] for one in beside}
        frames = dataclasses.replace(_renamed(frames, other, source), beside=known)
        return frames, [], () if source.given.sequence else other.folders()
    config = settings_of(database, source.labels_as)
    if beside and not source.given.segmenter:
        raise no_pictures
    files, segmenter = source.frames(config.labels_as)
    with progress_bar("encoding", len(files)) as bar:
        head, workers = query_head(config, columns), source.given.workers
        frames, skipped = encode_to_memory(head, files, workers, bar.advance, segmenter, beside)
    return frames, skipped, {(file.folder, file.sequence) for file in files}


def _renamed(frames: FrameSet, database: Database, source: Source) -> FrameSet:
    """The frames of a database that is the source, by the name of the sequence that was given."""
    if (name := source.given.sequence) is None:
        check_sequences(database.folders(), source.known)
        return frames
    if len(set(frames.sequences)) > 1:
        raise ValueError(f"--sequence names one sequence, {database.path} holds several")
    ids = tuple(f"{name}/{frame.rpartition('/')[2]}" for frame in frames.frames)
    return dataclasses.replace(frames, frames=ids, sequences=(name,) * len(frames))


def settings_of(database: Database, labels_as: LabelsAs | None) -> SSRVLADConfig:
    """The settings of a database, with another label space if one is given."""
    config = database.config
    return dataclasses.replace(
        config, labels_as=labels_as or only_label_space(database) or config.labels_as
    )


def only_label_space(database: Database) -> LabelSpace | None:
    """The one label space of the frames of a database; ``None`` for a new one."""
    spaces = database.label_spaces()
    if len(spaces) > 1:
        names = " and ".join(space.name for space in spaces)
        raise ValueError(f"{database.path} holds frames of {names}; say --labels-as")
    return spaces[0] if spaces else None


def _open_dataset(given: SourceOptions) -> Dataset | None:
    if given.layout and (given.poses or given.topic):
        raise ValueError("--poses and --topic are of folders and bags; a --layout has its own")
    if given.layout is None:
        if given.split or given.role or given.labels:
            raise ValueError("--split, --role and --labels want a --layout, for example auto")
        return None
    if len(given.paths) != 1:
        raise ValueError(
            f"--layout wants the folder of one data set, got {len(given.paths)} sources"
        )
    name = None if given.layout == "auto" else given.layout
    return open_dataset(given.paths[0], name, given.labels, given.labels_as)


def attempt(find: Callable[..., list[FrameFile]], *arguments: object) -> list[FrameFile]:
    """What is found, or nothing."""
    with suppress(ValueError):
        return find(*arguments)
    return []


_network = cache(open_network)


def _own_space(name: str, classes: str | None, required: bool) -> LabelSpace | None:
    """The label space that a network declares; ``None`` if it declares none and it is not
    required."""
    network = _network(name)
    if not network.class_names and network.labels_as is None and not required:
        return None
    return Segmenter.load(network, classes=channels(classes)).label_space


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"
