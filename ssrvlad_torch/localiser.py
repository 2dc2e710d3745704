"""Localiser: from a picture to a place."""

from __future__ import annotations

import dataclasses
import errno
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from .baselines.protocol import Frame
from .config import SSRVLADConfig
from .database.database import Database
from .database.frames import FrameSet
from .datasets.frame_file import FrameFile
from .datasets.image_files import Pixels, find_image_files, read_image
from .datasets.poses import Pose
from .descriptor import SSRVLAD, query_head
from .encoding.encoder import encode_to_database
from .encoding.extra_descriptors import check_segmenter, extra_descriptors, extra_methods
from .encoding.results import Summary
from .encoding.search import recognise_in
from .encoding.source import origin_of, require_network
from .recognition.confidence import Estimate, estimate
from .recognition.recognise import Steps
from .recognition.sweep import COLUMNS
from .segmentation.features import NAME as FEATURES
from .segmentation.networks import AUTO
from .segmentation.segmenter import Segmenter
from .taxonomy import LabelSpace

_ALONE = Steps(follow=None)


class Place(NamedTuple):
    """The best place for a picture among those of a database.

    Attributes:
        frame: id of the best frame of the database.
        score: its cosine (Eq. 4), at most 1; with extra descriptors the fused score of all.
        confidence: probability that the place is right, 0 to 1; 0 if the database has too few
            frames to estimate it.
        pose: of the frame, in metres and radians, with a heading of NaN if only that is unknown;
            ``None`` if it is unknown.
        estimate: how likely this answer is wrong; it accepts none if a decoy fits better, see
            `recognition.confidence`.
    """

    frame: str
    score: float
    confidence: float
    pose: Pose | None
    estimate: Estimate


class Localiser:
    """Finds the places of pictures: a network, the descriptor, and a database of known places.

    Each picture is judged alone. A drive is recognised far better as a whole: use `LoopDetector`
    for a stream, and ``ssrvlad locate`` for folders.

    Changes that are made through its `database` count at once; those of other processes when the
    database is opened again.

    Args:
        segmenter: labels pictures.
        database: of known places.

    Raises:
        ValueError: another network labelled frames of the database, or made its features.

    Examples:
        >>> localiser = Localiser.from_pretrained("net.yaml", "town.ssrdb")  # doctest: +SKIP
        >>> localiser.add("images/monday")  # doctest: +SKIP
        >>> localiser.locate("images/today/000007.jpg").frame  # doctest: +SKIP
        'monday/000007'
    """

    def __init__(self, segmenter: Segmenter, database: Database) -> None:
        self.segmenter, self.database = segmenter, database
        require_network(database, segmenter)
        config = dataclasses.replace(database.config, labels_as=segmenter.label_space)
        self._add, self._locate = SSRVLAD(config), query_head(config, COLUMNS)
        check_segmenter(segmenter, self._add.label_space, database.extra)
        self._methods = extra_methods(database.extra)
        self._features = any(each.name == FEATURES for each in database.extra)
        self._loaded: tuple[int, FrameSet] | None = None

    @classmethod
    def from_pretrained(
        cls,
        network: str | Path,
        database: str | Path,
        labels_as: str | LabelSpace = AUTO,
        preset: str | None = None,
        extra: Sequence[str] | None = None,
    ) -> Localiser:
        """A localiser with a network by its name.

        Args:
            network: its name, see `open_network`.
            database: folder or URI; created if it does not exist.
            labels_as: label space of the network's classes; with ``"auto"`` the names of the
                classes decide.
            preset: of a new database; without, ``"default"``.
            extra: extra descriptors of a new database, ``"features"`` and ``"hog"``, or ``"none"``;
                recognition fuses all. Without, features if the network has them.

        Raises:
            ValueError: as for the class, or the network cannot be used, or an existing database has
                another preset or other extra methods.
            OSError: downloading the network or writing the database failed.
            ImportError: an extra is not installed.
        """
        segmenter = Segmenter.load(network, labels_as)
        exists = Database.exists(database)
        if exists and preset is None and extra is None:
            return cls(segmenter, Database.open(database))
        stored = [] if exists and extra is None else extra_descriptors(extra, segmenter)
        config = SSRVLADConfig.from_preset(preset or "default", labels_as=segmenter.label_space)
        return cls(segmenter, Database.open_or_create(database, config, stored))

    @classmethod
    def open(cls, database: str | Path) -> Localiser:
        """A localiser with the network that labelled the frames of a database.

        Raises:
            ValueError: as `origin_of`, or the network has changed since.
        """
        opened = Database.open(database)
        origin = origin_of(opened)
        return cls(Segmenter.load(origin.network, origin.label_space or AUTO), opened)

    def __len__(self) -> int:
        """Number of frames in the database."""
        return len(self.database)

    def add(self, *sources: str | Path) -> Summary:
        """Adds the pictures that the database lacks, from folders, globs or files.

        Each folder is a sequence; ``poses.csv`` in or beside it holds the poses of its frames.

        Raises:
            ValueError: there are no pictures.
            OSError: the database cannot be written.
        """
        files = find_image_files([*map(str, sources)], known=self.database.folders())
        return encode_to_database(self._add, files, self.database, segmenter=self.segmenter)

    def locate(self, picture: Pixels | str | Path) -> Place | None:
        """The place of a picture.

        Args:
            picture: ``(H, W, 3)`` uint8 in RGB, or an image file.

        Returns:
            The best place, even at low confidence; ``None`` if the picture or every frame is empty.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: it is no picture, the network fails, or the database is empty or damaged.
        """
        if isinstance(picture, (str, os.PathLike)):
            path = Path(picture)
            if not path.exists():
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
            try:
                picture = read_image(FrameFile("", "", path))
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from error
        if not isinstance(picture, np.ndarray):
            raise ValueError(
                "expected a picture as an (H, W, 3) uint8 array or the path of a file, got "
                f"{type(picture).__name__}"
            )
        version = self.database.version  # others may add frames meanwhile
        if self._loaded is None or self._loaded[0] != version:
            self._loaded = version, self.database.load()
        references = self._loaded[1]
        if not references.frames:
            raise ValueError(f"{self.database.path} holds no frames yet")
        (said,) = self.segmenter.segment([picture], features=self._features)
        frame = Frame("picture", image=picture)
        extra = {each.name: each.encode_query([frame]) for each in self._methods}
        if said.features is not None:
            extra[FEATURES] = torch.from_numpy(said.features)[None]
        vectors = self._locate(torch.from_numpy(said.labels)[None])
        found = recognise_in(self.database, references, vectors, extra, ["picture"], _ALONE, top=1)
        row = int(found.matches.indices[0, 0])
        if row < 0:
            return None
        score = min(1.0, float(found.matches.scores[0, 0]))
        pose = Pose(*references.poses[row].tolist())
        known = None if math.isnan(pose.x) else pose
        sure = float(found.confidence[0])
        return Place(references.frames[row], score, sure, known, estimate(found.sure))
