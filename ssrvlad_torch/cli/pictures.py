"""Pictures of frames: their coloured label maps and their photos, where these can be found."""

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
from ..evaluation.report import Picture, Pictures
from ..segmentation.segmenter import Segmenter
from ..taxonomy import colourise, label_space
from .sources import LabelsAs, Source, try_find

Files = dict[str, list[FrameFile]]


class PictureFiles(NamedTuple):
    """Files that may belong to one frame.

    Attributes:
        labels: label maps.
        images: images to segment.
        photos: images that certainly belong to the frame.
    """

    labels: Sequence[FrameFile] = ()
    images: Sequence[FrameFile] = ()
    photos: Sequence[FrameFile] = ()

    def picture(
        self, labels_as: LabelsAs, segmenter: Segmenter | None = None, expected: str | None = None
    ) -> Picture:
        """The picture of the frame, without the parts that cannot be found or read.

        Args:
            labels_as: label space of its label map.
            segmenter: labels the images.
            expected: digest of the label map, if known.
        """
        photo = next((image for file in self.photos for image in _read(file)), None)
        for labels, image in self._labelled(labels_as, segmenter):
            if expected in (None, digest(labels)):
                return Picture(colourise(labels, labels_as), photo if image is None else image)
        return Picture(None, photo)

    def _labelled(
        self, labels_as: LabelsAs, segmenter: Segmenter | None
    ) -> Iterator[tuple[LabelMap, Pixels | None]]:
        """Label maps, each with its image, or with ``None`` for a label map on disk."""
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

    def picture(frame: str) -> Picture:
        if labels_as is None:
            return Picture(photo=next(_read(by_id[frame]), None))
        return PictureFiles(labels=[by_id[frame]]).picture(labels_as)

    return picture


def pictures_of_queries(source: Source, labels_as: LabelsAs) -> Pictures:
    """Pictures of the frames of a source, with the photos of its data set."""

    @cache
    def frames() -> tuple[Files, Segmenter | None]:
        files, segmenter = source.frames(labels_as)
        return _by(files, "frame"), segmenter

    @cache
    def photos() -> Files:
        return _by(_photos(source.whole), "frame")

    def picture(frame: str) -> Picture:
        files, segmenter = frames()
        if segmenter:
            return PictureFiles(images=files[frame]).picture(labels_as, segmenter)
        return PictureFiles(files[frame], photos=photos().get(frame, ())).picture(labels_as)

    return picture


def pictures_of_references(
    database: Database, source: Source, places: Sequence[str], labels_as: LabelsAs
) -> Pictures:
    """Pictures of the frames of a database, which stores neither label maps nor their paths.

    Files with the names of the frames are searched in the given places, in the data set of the
    queries, and, beside the folders of the queries, in folders with the names of the sequences. A
    label map is shown only if its digest is the one in the database.

    Args:
        database: of the references.
        source: of the queries.
        places: folders, globs or files.
        labels_as: label space of the segmenter.
    """
    stored = cache(database.known)

    @cache
    def found() -> tuple[Files, Files, Files]:
        sequences = {frame.rpartition("/")[0] for frame in stored()}
        labels = _around(source, places, sequences, find_label_files)
        segmented = bool(source.options.segmenter)
        images = _around(source, places, sequences, find_image_files) if segmented else []
        if whole := source.whole:
            images += try_find(whole.image_files) if segmented else []
            labels += try_find(whole.label_files)
            labels += try_find(lambda: open_dataset(whole.root, whole.layout).label_files())
        return _by(labels, "name"), _by(images, "name"), _by(_photos(source.whole), "frame")

    segmenter = cache(lambda: source.segmenter(labels_as))

    def picture(frame: str) -> Picture:
        (labels, images, photos), name = found(), frame.rpartition("/")[2]
        files = PictureFiles(labels.get(name, ()), images.get(name, ()), photos.get(frame, ()))
        with suppress(ValueError):
            record = stored()[frame]
            origin = database.origins.get(record.origin)
            if origin and origin.label_space:
                return files.picture(origin.label_space, segmenter(), record.digest)
        return Picture()

    return picture


def require_files(places: Sequence[str]) -> None:
    """Refuses places with neither label maps nor images."""
    for place in places:
        if not try_find(find_label_files, [place]):
            find_image_files([place])


def _around(
    source: Source,
    places: Sequence[str],
    sequences: Iterable[str],
    find: Callable[[list[str]], list[FrameFile]],
) -> list[FrameFile]:
    """The files that ``find`` finds in the places, and, beside the folders of the queries, in
    folders with the names of the sequences."""
    queries = source.image_files() if source.options.segmenter else source.label_files()
    parents = {file.path.absolute().parent.parent for file in queries}
    beside = [str(parent / name) for parent in parents for name in sequences]
    groups = [[*places], *([folder] for folder in beside if Path(folder).is_dir())]
    return [file for group in groups if group for file in try_find(find, group)]


def _photos(dataset: Dataset | None) -> Iterator[FrameFile]:
    """The images of a data set, without files that may be label maps."""
    for frame in dataset.frames if dataset else ():
        if frame.image and frame.image != frame.label:
            yield FrameFile(frame.sequence, frame.name, frame.image)


def _read(file: FrameFile) -> Iterator[Pixels]:
    """The image, unless it cannot be read."""
    with suppress(ValueError):
        yield read_image(file)


def _by(files: Iterable[FrameFile], attribute: str) -> Files:
    grouped: Files = {}
    for file in files:
        grouped.setdefault(getattr(file, attribute), []).append(file)
    return grouped
