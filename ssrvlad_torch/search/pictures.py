"""Pictures of frames: their photos and their coloured label maps, read where they were encoded."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache

from ..database.database import Database
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile, found_by
from ..datasets.image_files import Pixels, find_image_files, read_image
from ..datasets.label_files import find_label_files, read_label_map
from ..evaluation.report import Pictures
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace, colourise, label_space

PHOTO, LABELS = "photo", "label map"


def pictures_of_queries(
    files: Sequence[FrameFile],
    dataset: Dataset | None,
    labels_as: str | LabelSpace,
    segmenter: Segmenter | None,
) -> Pictures:
    """Pictures of frames, with the photos of their data set; the segmenter labels photos."""
    by_id = cache(lambda: {file.frame: file for file in files})
    photos = cache(lambda: _photos(dataset))

    def pictures(frame: str) -> Mapping[str, Pixels]:
        file = by_id().get(frame)
        if file is None:
            return {}
        return dict(_pictures(file, label_space(labels_as), segmenter, photos().get(frame)))

    return pictures


def pictures_of_references(
    database: Database, dataset: Dataset | None, network: Segmenter | None
) -> Pictures:
    """Pictures of the frames of a database, from the files that it was encoded from; none of a file
    that has changed or is gone. The network labels photos."""
    stored = cache(database.known)
    photos = cache(lambda: _photos(dataset))

    @cache
    def files_in(folder: str) -> dict[str, FrameFile]:
        found = [
            f for find in (find_image_files, find_label_files) for f in found_by(find, [folder])
        ]
        return {file.signature() + file.name: file for file in found}

    def pictures(frame: str) -> Mapping[str, Pixels]:
        record = stored()[frame]
        file = files_in(record.folder).get(record.signature + record.name)
        origin = database.origins.get(record.origin)
        if file is None or origin is None or origin.label_space is None:
            return {}
        labels = network if origin.segmenter else None
        if origin.segmenter and (labels is None or labels.label_space != origin.label_space):
            return dict(_photo(file))
        return dict(_pictures(file, origin.label_space, labels, photos().get(frame)))

    return pictures


def _pictures(
    file: FrameFile, space: LabelSpace, segmenter: Segmenter | None, photo: FrameFile | None
) -> Iterator[tuple[str, Pixels]]:
    """The pictures of a label map and its photo, or, with a segmenter, of a photo and its label
    map; without those that cannot be read."""
    if segmenter is None:
        if photo:
            yield from _photo(photo)
        with suppress(ValueError):
            yield LABELS, colourise(read_label_map(file, space), space)
        return
    yield from _photo(file)
    for _, labels in segmenter.label_maps([file]):
        if not isinstance(labels, ValueError):
            yield LABELS, colourise(labels, space)


def _photo(file: FrameFile) -> Iterator[tuple[str, Pixels]]:
    with suppress(ValueError):
        yield PHOTO, read_image(file)


def _photos(dataset: Dataset | None) -> dict[str, FrameFile]:
    """The images of a data set by id, without files that may be label maps."""
    return {
        frame.frame: FrameFile(frame.sequence, frame.name, frame.image)
        for frame in (dataset.frames if dataset else ())
        if frame.image and frame.image != frame.label
    }
