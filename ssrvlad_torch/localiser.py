"""Localiser: a picture in, a place out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from .baselines.protocol import Frame
from .config import SSRVLADConfig
from .database.database import Database
from .database.frames import FrameSet
from .database.metadata import Origin
from .datasets.frame_file import FrameFile
from .datasets.image_files import Pixels, find_image_files, read_image
from .datasets.poses import Pose
from .descriptor import SSRVLAD, query_head
from .encoding.encoder import encode_to_database
from .encoding.extra_descriptors import extra_descriptor, extra_methods
from .encoding.results import Summary
from .recognition.recognise import Steps, recognise
from .recognition.sweep import COLUMNS
from .segmentation.networks import AUTO, runs_code
from .segmentation.segmenter import Segmenter
from .taxonomy import LabelSpace

_ALONE = Steps(follow=None)


class Place(NamedTuple):
    """Where a picture was taken, as far as a database knows.

    Attributes:
        frame: id of the best frame of the database.
        score: its cosine (Eq. 4), see `recognise`.
        confidence: probability that the place is right, 0 to 1; 0 where the database has too few
            frames to tell.
        pose: of that frame: metres and radians, NaN where unknown.
    """

    frame: str
    score: float
    confidence: float
    pose: Pose


class Localiser:
    """Pictures to places: a network, the descriptor, and a database of known places.

    It judges every picture by itself. A drive is recognised far better as a whole: that is
    `LoopDetector` for a stream, and ``ssrvlad locate`` for folders.

    Args:
        segmenter: labels pictures.
        database: of known places.

    Raises:
        ValueError: another network made frames of the database.

    Example:
        >>> localiser = Localiser.from_pretrained("net.yaml", "town.ssrdb")  # doctest: +SKIP
        >>> localiser.add("images/monday")  # doctest: +SKIP
        >>> localiser.locate("images/today/000007.jpg").frame  # doctest: +SKIP
        'monday/000007'
    """

    def __init__(self, segmenter: Segmenter, database: Database) -> None:
        self.segmenter, self.database = segmenter, database
        see_made_by(database, segmenter)
        config = dataclasses.replace(database.config, labels_as=segmenter.label_space)
        self._add, self._locate = SSRVLAD(config), query_head(config, COLUMNS)
        self._methods = extra_methods(database.beside)
        self._known: FrameSet | None = None

    @classmethod
    def from_pretrained(
        cls,
        network: str | Path,
        database: str | Path,
        labels_as: str | LabelSpace = AUTO,
        preset: str | None = None,
        beside: str | None = None,
    ) -> Localiser:
        """A localiser by the name of its network.

        Args:
            network: see `open_network` for the names.
            database: folder or URI; a new one is made where there is none.
            labels_as: label space of the network's classes; ``"auto"`` is what their names mean.
            preset: of a new database; ``"default"`` if not given.
            beside: ``"hog"`` describes each picture of a new database by it, too, and recognition
                fuses both.

        Raises:
            ValueError: as for the class, or the network cannot be used, or the database that is
                there has another preset, or not what shall be beside.
            OSError: the network cannot be downloaded, or the database not be written.
            ImportError: a missing extra.
        """
        segmenter = Segmenter.load(network, labels_as)
        also = [extra_descriptor(beside)] if beside else []
        if Database.exists(database) and preset is None and not also:
            return cls(segmenter, Database.open(database))
        config = SSRVLADConfig.from_preset(preset or "default", labels_as=segmenter.label_space)
        return cls(segmenter, Database.open_or_create(database, config, also))

    @classmethod
    def open(cls, database: str | Path) -> Localiser:
        """A localiser by the network that made a database, which the database names.

        Raises:
            ValueError: as `made_by`, or the network is no longer the same.
        """
        opened = Database.open(database)
        origin = made_by(opened)
        return cls(Segmenter.load(origin.network, origin.label_space or AUTO), opened)

    def __len__(self) -> int:
        """Frames of the database."""
        return len(self.database)

    def add(self, *sources: str | Path) -> Summary:
        """Adds pictures to the database, those that it lacks: folders, globs or files.

        A folder is a sequence; ``poses.csv`` in or beside it gives its frames positions.

        Raises:
            ValueError: there are no pictures.
            OSError: the database cannot be written.
        """
        files = find_image_files([*map(str, sources)], known=self.database.folders())
        self._known = None
        return encode_to_database(self._add, files, self.database, segmenter=self.segmenter)

    def locate(self, picture: Pixels | str | Path) -> Place | None:
        """Where a picture was taken.

        Args:
            picture: ``(H, W, 3)`` uint8 in RGB, or an image file.

        Returns:
            the best place, however unsure: see its confidence. ``None`` if the picture is
            empty or all frames are.

        Raises:
            ValueError: it is no picture, the network fails, or the database is empty or damaged.
        """
        if not isinstance(picture, np.ndarray):
            picture = _read(Path(picture))
        known = self._references()
        (labels,) = self.segmenter([picture])
        frame = Frame("picture", image=picture)
        found = recognise(
            self._locate(torch.from_numpy(labels)[None]),
            known.descriptors,
            ["picture"],
            known.sequences,
            _ALONE,
            top=1,
            beside={
                each.name: (each.encode_query([frame]), known.beside[each.name])
                for each in self._methods
            },
        )
        row = int(found.matches.indices[0, 0])
        if row < 0:
            return None
        score, sure = float(found.matches.scores[0, 0]), float(found.confidence[0])
        return Place(known.frames[row], score, sure, Pose(*known.poses[row].tolist()))

    def _references(self) -> FrameSet:
        if self._known is None:
            self._known = self.database.load()
        if not self._known.frames:
            raise ValueError(f"{self.database.path} holds no frames yet")
        return self._known


def made_by(database: Database) -> Origin:
    """The one network, with its label space, that made the frames of a database.

    Raises:
        ValueError: no network did, or several; or it has no name, or one that runs code, which
            only the user may ask for.
    """
    origins = [origin for origin in database.origins.values() if origin.segmenter]
    if not origins:
        raise ValueError(f"{database.path} was not made from pictures; name a --segmenter")
    names = dict.fromkeys(origin.network or "a network without a name" for origin in origins)
    if len(origins) > 1 or not origins[0].network:
        raise ValueError(f"{database.path} was made by {', '.join(names)}; name the --segmenter")
    if runs_code(origins[0].network):
        raise ValueError(f"{database.path} was made by code: say --segmenter {origins[0].network}")
    return origins[0]


def see_made_by(database: Database, segmenter: Segmenter) -> None:
    """Refuses a network that did not make the frames of a database.

    Raises:
        ValueError: another network made some.
    """
    others = {origin.segmenter: origin.network for origin in database.origins.values()}
    others.pop("", None)
    if others and others.keys() != {segmenter.key()}:
        mine = segmenter.name or "the network at hand"
        theirs = ", ".join(name or "a network without a name" for name in others.values())
        raise ValueError(
            f"{database.path} was made by {theirs} as it was then; {mine} gives other label maps"
        )


def _read(path: Path) -> Pixels:
    try:
        return read_image(FrameFile("", "", path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
