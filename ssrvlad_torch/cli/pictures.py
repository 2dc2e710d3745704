"""How frames look: their label maps in colours and their photos, wherever they can be found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from ..database.database import Database
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile
from ..datasets.image_files import Pixels, find_image_files, read_image
from ..datasets.label_files import LabelMap, digest, find_label_files, read_label_map
from ..datasets.layouts import open_dataset
from ..evaluation.report import Picture
from ..segmentation.segmenter import Segmenter
from ..taxonomy import colourise, label_space
from .sources import LabelsAs, Source

Files = dict[str, list[FrameFile]]
Pictures = Callable[[str], Picture]
"""From a frame's id to its picture; no file is looked for before it is called."""


class Traces(NamedTuple):
    """Files that may be of one frame.

    Attributes:
        labels: label maps.
        images: images to be segmented.
        photos: images that are known to be the frame's.
    """

    labels: Sequence[FrameFile] = ()
    images: Sequence[FrameFile] = ()
    photos: Sequence[FrameFile] = ()

    def look(
        self, labels_as: LabelsAs, segmenter: Segmenter | None = None, wanted: str | None = None
    ) -> Picture:
        """What the frame looks like; what cannot be found or read is left out.

        Args:
            labels_as: label space of its label map.
            segmenter: makes label maps of images.
            wanted: digest that the label map must have, if it is known.
        """
        photo = next((image for file in self.photos for image in _read(file)), None)
        for labels, image in self._labelled(labels_as, segmenter):
            if wanted in (None, digest(labels)):
                return Picture(colourise(labels, labels_as), photo if image is None else image)
        return Picture(None, photo)

    def _labelled(
        self, labels_as: LabelsAs, segmenter: Segmenter | None
    ) -> Iterator[tuple[LabelMap, Pixels | None]]:
        """Label maps, each with the image that it was made of, if any."""
        space = label_space(labels_as)
        if segmenter and segmenter.label_space == space:
            for file, labels in segmenter.label_maps(self.images):
                if not isinstance(labels, ValueError):
                    yield from ((labels, image) for image in _read(file))
        for file in self.labels:
            with suppress(ValueError):
                yield read_label_map(file, space), None


def pictures_of_files(files: Sequence[FrameFile], labels_as: LabelsAs | None) -> Pictures:
    """Pictures of frames that are label maps, or, without a label space, images."""
    by_id = {file.frame: file for file in files}

    def look(frame: str) -> Picture:
        if labels_as is None:
            return Picture(photo=next(_read(by_id[frame]), None))
        return Traces(labels=[by_id[frame]]).look(labels_as)

    return look


def pictures_of_queries(source: Source, labels_as: LabelsAs) -> Pictures:
    """Pictures of the frames of a source, with the photos that a data set has of them."""

    @cache
    def found() -> tuple[Files, Segmenter | None]:
        files, segmenter = source.frames(labels_as)
        return _by(files, _id), segmenter

    @cache
    def photos() -> Files:
        return _by(_photos(source.whole), _id)

    def look(frame: str) -> Picture:
        files, segmenter = found()
        if segmenter:
            return Traces(images=files[frame]).look(labels_as, segmenter)
        return Traces(labels=files[frame], photos=photos().get(frame, ())).look(labels_as)

    return look


def pictures_of_references(
    database: Database, source: Source, given: Sequence[str], labels_as: LabelsAs
) -> Pictures:
    """Pictures of the frames of a database, which has neither label maps nor where they were.

    They are looked for, by the names of the frames, among what was given, in the data set of the
    queries, and in folders that are called like their sequences beside those of the queries. What
    is found counts if its digest is that in the database.

    Args:
        source: of the queries.
        given: folders, globs or files.
        labels_as: label space of the segmenter, if the source has one.
    """

    stored = cache(database.known)

    @cache
    def found() -> tuple[Files, Files, Files]:
        sequences = {frame.rpartition("/")[0] for frame in stored()}
        labels = [*_around(source, given, sequences, find_label_files)]
        images = [*_around(source, given, sequences, find_image_files)]
        if whole := source.whole:
            images += _attempt(whole.image_files)
            labels += _attempt(whole.label_files)
            labels += _attempt(lambda: open_dataset(whole.root, whole.layout).label_files())
        images = images if source.given.segmenter else []
        return _by(labels, _name), _by(images, _name), _by(_photos(source.whole), _id)

    segmenter = cache(lambda: source.segmenter(labels_as))

    def look(frame: str) -> Picture:
        (labels, images, photos), name = found(), frame.rpartition("/")[2]
        traces = Traces(labels.get(name, ()), images.get(name, ()), photos.get(frame, ()))
        with suppress(ValueError):
            known = stored()[frame]
            origin = database.origins.get(known.origin)
            if origin and origin.label_space:
                return traces.look(origin.label_space, segmenter(), known.digest)
        return Picture()

    return look


def require_files(given: Sequence[str]) -> None:
    """Refuses places with neither label maps nor images, before the work is done.

    Raises:
        ValueError: one holds none, or is not there.
    """
    for place in given:
        if not _attempt(find_label_files, [place]):
            find_image_files([place])


def _around(
    source: Source,
    given: Sequence[str],
    sequences: Iterable[str],
    find: Callable[[list[str]], list[FrameFile]],
) -> Iterator[FrameFile]:
    """What is found in the places that were given, and beside the queries."""
    if given:
        yield from _attempt(find, [*given])
    for folder in _beside(source, sequences):
        yield from _attempt(find, [str(folder)])


def _beside(source: Source, sequences: Iterable[str]) -> Iterator[Path]:
    """Folders called like the sequences, beside those that the frames of a source lie in."""
    find = source.image_files if source.given.segmenter else source.label_files
    for place in {file.path.absolute().parent.parent for file in find()}:
        yield from (place / name for name in sequences if (place / name).is_dir())


def _photos(dataset: Dataset | None) -> Iterator[FrameFile]:
    """The images of a data set; a file that may be an image or a label map is none."""
    for frame in dataset.frames if dataset else ():
        if frame.image and frame.image != frame.label:
            yield FrameFile(frame.sequence, frame.name, frame.image)


def _attempt(find: Callable[..., list[FrameFile]], *arguments: object) -> list[FrameFile]:
    """What is found; nothing where there is nothing."""
    with suppress(ValueError):
        return find(*arguments)
    return []


def _read(file: FrameFile) -> Iterator[Pixels]:
    """An image, if it can be read."""
    with suppress(ValueError):
        yield read_image(file)


def _by(files: Iterable[FrameFile], key: Callable[[FrameFile], str]) -> Files:
    grouped: Files = {}
    for file in files:
        grouped.setdefault(key(file), []).append(file)
    return grouped


def _id(file: FrameFile) -> str:
    return file.frame


def _name(file: FrameFile) -> str:
    return file.name
