"""How frames look: their label maps in colours and their photos, wherever they can be found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
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
from .sources import LabelsAs, Source, attempt

Files = dict[str, list[FrameFile]]


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
            wanted: digest that the label map must have, if known.
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
        return _by(files, "frame"), segmenter

    @cache
    def photos() -> Files:
        return _by(_photos(source.whole), "frame")

    def look(frame: str) -> Picture:
        files, segmenter = found()
        if segmenter:
            return Traces(images=files[frame]).look(labels_as, segmenter)
        return Traces(labels=files[frame], photos=photos().get(frame, ())).look(labels_as)

    return look


def pictures_of_references(
    database: Database, source: Source, given: Sequence[str], labels_as: LabelsAs
) -> Pictures:
    """Pictures of the frames of a database, which holds neither label maps nor their places.

    They are looked for by the names of the frames: in the given places, in the data set of the
    queries, and in folders that are called like the sequences, beside those of the queries. A label
    map counts if its digest is the one in the database.

    Args:
        source: of the queries.
        given: folders, globs or files.
        labels_as: label space of the segmenter, if the source has one.
    """

    stored = cache(database.known)

    @cache
    def found() -> tuple[Files, Files, Files]:
        sequences = {frame.rpartition("/")[0] for frame in stored()}
        labels = _around(source, given, sequences, find_label_files)
        segmented = bool(source.given.segmenter)
        images = _around(source, given, sequences, find_image_files) if segmented else []
        if whole := source.whole:
            images += attempt(whole.image_files) if segmented else []
            labels += attempt(whole.label_files)
            labels += attempt(lambda: open_dataset(whole.root, whole.layout).label_files())
        return _by(labels, "name"), _by(images, "name"), _by(_photos(source.whole), "frame")

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
    """Refuses places with neither label maps nor images, before the work is done."""
    for place in given:
        if not attempt(find_label_files, [place]):
            find_image_files([place])


def _around(
    source: Source,
    given: Sequence[str],
    sequences: Iterable[str],
    find: Callable[[list[str]], list[FrameFile]],
) -> list[FrameFile]:
    """What is found in the given places, and in folders that are called like the sequences and lie
    beside the folders of the queries."""
    queries = source.image_files() if source.given.segmenter else source.label_files()
    homes = {file.path.absolute().parent.parent for file in queries}
    beside = [home / name for home in homes for name in sequences if (home / name).is_dir()]
    places = [[*given]] if given else []
    return [
        file for place in [*places, *([str(f)] for f in beside)] for file in attempt(find, place)
    ]


def _photos(dataset: Dataset | None) -> Iterator[FrameFile]:
    """The images of a data set; a file that may be an image or a label map is none."""
    for frame in dataset.frames if dataset else ():
        if frame.image and frame.image != frame.label:
            yield FrameFile(frame.sequence, frame.name, frame.image)


def _read(file: FrameFile) -> Iterator[Pixels]:
    """An image, if it can be read."""
    with suppress(ValueError):
        yield read_image(file)


def _by(files: Iterable[FrameFile], attribute: str) -> Files:
    grouped: Files = {}
    for file in files:
        grouped.setdefault(getattr(file, attribute), []).append(file)
    return grouped
