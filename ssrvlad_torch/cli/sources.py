"""From what the user typed to frames: folders or a data set, label maps or images to segment."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..config import SSRVLADConfig
from ..database.database import Database, FrameSet
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile
from ..datasets.image_files import find_image_files
from ..datasets.label_files import find_label_files
from ..datasets.layouts import open_dataset
from ..descriptor import SSRVLAD
from ..encoding.encoder import Refusal, encode_to_memory
from ..segmentation.segmenter import Segmenter
from .options import Choosing, Segmenting, Selection
from .output import note, progress_bar


@dataclass(frozen=True)
class Source:
    """Where frames come from.

    Attributes:
        paths: folders, globs or files, or the folder of the data set.
        dataset: what was chosen of it, if it is one.
        whole: the data set with all its sequences.
        labels_as: label space of the label maps, as given or as the data set knows it.
        selection: the frames that are taken of each sequence.
        segmenting: how images become label maps, if they do.
        workers: threads that read ahead.
    """

    paths: Sequence[str]
    dataset: Dataset | None
    whole: Dataset | None
    labels_as: str | None
    selection: Selection
    segmenting: Segmenting
    workers: int

    @classmethod
    def open(
        cls,
        paths: Sequence[str],
        labels_as: str | None,
        choosing: Choosing,
        selection: Selection,
        segmenting: Segmenting,
        workers: int,
    ) -> Source:
        """Opens the data set, if it is one; what it lacks is noted.

        Raises:
            ValueError: the options do not fit together, or the data set does not fit them.
        """
        whole = _open_dataset(paths, labels_as, choosing)
        dataset = whole and whole.select(choosing.splits or (), choosing.role)
        for warning in dataset.warnings if dataset else ():
            note(warning)
        labels_as = labels_as or (dataset.labels_as if dataset else None)
        return cls(paths, dataset, whole, labels_as, selection, segmenting, workers)

    def posed(self) -> Source:
        """The same, of a data set only the frames with a pose."""
        return dataclasses.replace(self, dataset=self.dataset and self.dataset.posed())

    def frames(self, labels_as: str) -> tuple[list[FrameFile], Segmenter | None]:
        """The frames, and what makes label maps of them if they are images.

        Raises:
            ValueError: there are none, or the segmenter cannot be used.
        """
        segmenter = self.segmenter(labels_as)
        return self.image_files() if segmenter else self.label_files(), segmenter

    def segmenter(self, labels_as: str) -> Segmenter | None:
        """What makes label maps of images, if one was given.

        Raises:
            ValueError: it cannot be used.
        """
        network, cache = self.segmenting.network, self.segmenting.cache
        if network is None:
            if cache is not None:
                raise ValueError("--segmenter-cache wants a --segmenter")
            return None
        return Segmenter.load(network, labels_as, cache or _user_cache())

    def label_files(self) -> list[FrameFile]:
        """The frames that are label maps."""
        taken = self.selection
        if self.dataset:
            return self.dataset.label_files(taken.every, taken.start)
        return find_label_files(self.paths, taken.sequence, taken.every, taken.start)

    def image_files(self) -> list[FrameFile]:
        """The frames that are images."""
        taken = self.selection
        if self.dataset:
            return self.dataset.image_files(taken.every, taken.start)
        return find_image_files(self.paths, taken.sequence, taken.every, taken.start)


def load(database: Path, source: Source, temporal: int) -> tuple[FrameSet, FrameSet, list[Refusal]]:
    """The frames of a database after Eq. 3, the queries encoded alike, and the refused ones.

    Raises:
        ValueError: the database is empty or damaged, or there are no queries.
    """
    opened = Database.open(database)
    references = opened.load(temporal)
    if not references.frames:
        raise ValueError(f"{database} holds no frames yet")
    queries, refused = encode_queries(opened.config, source)
    return references, queries, refused


def encode_queries(config: SSRVLADConfig, source: Source) -> tuple[FrameSet, list[Refusal]]:
    """Frames encoded with the settings of a database, and the refused ones.

    Raises:
        ValueError: there are no frames.
    """
    config = with_labels_as(config, source.labels_as)
    files, segmenter = source.frames(config.labels_as)
    with progress_bar("encoding", len(files)) as advance:
        return encode_to_memory(SSRVLAD(config), files, source.workers, advance, segmenter)


def with_labels_as(config: SSRVLADConfig, labels_as: str | None) -> SSRVLADConfig:
    """The settings for label maps of another label space, if one is given."""
    return dataclasses.replace(config, labels_as=labels_as or config.labels_as)


def _open_dataset(
    paths: Sequence[str], labels_as: str | None, choosing: Choosing
) -> Dataset | None:
    if choosing.layout is None:
        if choosing.splits or choosing.role or choosing.labels:
            raise ValueError("--split, --role and --labels want a --layout, for example auto")
        return None
    if len(paths) != 1:
        raise ValueError(f"--layout wants the folder of one data set, got {len(paths)} sources")
    name = None if choosing.layout == "auto" else choosing.layout
    return open_dataset(paths[0], name, choosing.labels, labels_as)


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"
