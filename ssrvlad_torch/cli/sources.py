"""What the user means by SOURCE: folders, a data set or a database, label maps or images."""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from ..database.database import Database
from ..database.metadata import ExtraDescriptor
from ..datasets.dataset import Dataset
from ..datasets.frame_files import FrameFile, found_by
from ..datasets.image_files import find_image_files, read_image
from ..datasets.label_files import find_label_files, read_label_map
from ..datasets.layouts import open_dataset
from ..datasets.names import KnownFolders
from ..encoding.extra_descriptors import extra_descriptors
from ..encoding.source import Source, origin_of, require_network
from ..segmentation.features import NAME as FEATURES
from ..segmentation.networks import ACCEPT, AUTO, open_network
from ..segmentation.preparation import channels
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace, label_space
from .options import SourceOptions
from .output import note

_OF_FILES = ("poses", "largest_gap", "topic", "fps", "every", "start", "segmenter", "classes")


def resolve(
    options: SourceOptions,
    database: Database | None = None,
    *,
    compared: bool = False,
    images: bool = False,
    listed: bool = True,
    posed: bool | None = False,
) -> Source:
    """The source, before its first frame is read. Notes what a data set lacks, and the network that
    labels pictures if the user names none.

    Frames are ``compared`` with a database, where the source may be a database itself, or added to
    it; the source can only be ``images``; its files are ``listed``; frames of a data set without a
    pose are left out if ``posed``, or with ``None`` if its ground truth is by poses. Options that
    do not go together, no frames, no label space, and a network of the database that cannot be
    opened or has changed are a ValueError.
    """
    whole = _open_dataset(options)
    dataset = whole and whole.select(options.split or (), options.role)
    for warning in dataset.warnings if dataset else ():
        note(warning)
    network, paths = options.segmenter, options.paths
    labels_as: str | LabelSpace | None = options.labels_as
    if network and labels_as in (None, AUTO):
        opened = _network(network)
        if labels_as or opened.class_names or opened.labels_as is not None:
            labels_as = Segmenter.load(opened, classes=channels(options.classes)).label_space
    labels_as = labels_as or (dataset.labels_as if dataset else None)
    truth = dataset.truth if dataset else None
    if dataset and (posed or (posed is None and truth and truth.metres is not None)):
        dataset = dataset.posed()
    known = database.folders() if database else ()
    found = Source(
        sequence=options.sequence, dataset=whole, truth=truth, known=known, workers=options.workers
    )
    if compared and len(paths) == 1 and Database.exists(paths[0]):
        if unused := [f"--{name.replace('_', '-')}" for name in options.given(*_OF_FILES)]:
            raise ValueError(f"{paths[0]} is a database: expected no {', '.join(unused)}")
        space = _space(labels_as, database, compared, images)
        return replace(found, labels_as=space, database=Database.open(paths[0]))
    find = partial(_find, options, dataset, known)
    if database and not network and (images or not labels_as):
        spaces = [origin.label_space for origin in database.origins.values() if origin.segmenter]
        if images or (spaces and _are_pictures(found_by(find, find_image_files), spaces)):
            origin = origin_of(database)
            network = origin.network
            labels_as = origin.label_space or label_space(database.config.labels_as)
    space = _space(labels_as, database, compared, images)
    segmenter = _segmenter(network, options, space) if space else None
    if segmenter and database and not options.segmenter:
        require_network(database, segmenter)
        note(f"{network}, the network of {database.path}, labels the pictures")
    found = replace(found, labels_as=space, segmenter=segmenter)
    if not listed:
        return found
    kind = find_image_files if images or segmenter else find_label_files
    try:
        return replace(found, files=find(kind))
    except ValueError:
        only_images = (
            not (dataset or segmenter or images)
            and not any(found_by(find_label_files, [path]) for path in paths)
            and found_by(find_image_files, paths)
        )
        if only_images:
            raise ValueError(
                f"{' '.join(paths)} holds images and no label maps; name the network that "
                "labels them with --segmenter"
            ) from None
        raise


def extra_of(source: Source, names: Sequence[str] | None, new: bool) -> list[ExtraDescriptor]:
    """The extra descriptors that ``--with`` names; without, the default of a new database, with
    a note why a network has no features, and none of an existing one."""
    segmenter = source.segmenter
    if names and segmenter is None:
        raise ValueError(f"--with {names[0]} needs images as SOURCE and --segmenter")
    if names is None and not (new and segmenter):
        return []
    found = extra_descriptors(names, segmenter)
    if names is None and segmenter and FEATURES not in {each.name for each in found}:
        note(f"stored without features: {segmenter.problem_of_features}")
    return found


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
        raise ValueError("Missing option '--labels-as': label space of the label maps")
    return labels_as or ""


def _segmenter(
    network: str | None, options: SourceOptions, labels_as: str | LabelSpace
) -> Segmenter | None:
    """The segmenter with its cache; ``None`` without a network."""
    folder = options.segmenter_cache
    if network is None:
        if folder is not None:
            raise ValueError("--segmenter-cache needs --segmenter")
        return None
    classes, opened = channels(options.classes), _network(network)
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ssrvlad"
    segmenter = Segmenter.load(opened, labels_as, folder, classes)
    if opened.assumed:
        note(
            f"{network} does not say how it wants pictures; assumed: {opened.preparation} "
            f"({ACCEPT}: true in a YAML file accepts that)"
        )
    return segmenter


def _find(
    options: SourceOptions,
    dataset: Dataset | None,
    known: KnownFolders,
    find: Callable[..., list[FrameFile]],
) -> list[FrameFile]:
    """The frames that ``find`` finds, or those of the data set."""
    if dataset:
        of = dataset.image_files if find is find_image_files else dataset.label_files
        return of(options.every, options.start)
    names = ("sequence", "every", "start", "poses", "topic", "fps", "largest_gap")
    return find(options.paths, known=known, **{name: getattr(options, name) for name in names})


def _are_pictures(files: Sequence[FrameFile], spaces: Sequence[LabelSpace | None]) -> bool:
    """Whether the first file that can be read is no label map of any of the label spaces."""
    for file in files:
        for space in filter(None, spaces):
            with suppress(ValueError):
                ids = np.unique(read_label_map(file, space)).tolist()
                if {*ids} <= {each.id for each in space.classes}:
                    return False
        with suppress(ValueError):
            read_image(file)
            return True
    return False


def _open_dataset(options: SourceOptions) -> Dataset | None:
    if options.layout and options.given("sequence", "poses", "topic", "fps"):
        raise ValueError("--sequence, --poses, --topic and --fps do not go with --layout")
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
