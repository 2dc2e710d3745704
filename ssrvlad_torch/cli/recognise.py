"""Finding the candidates of queries: in a database, or by another method on frames on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from .. import baselines
from ..baselines.run import run
from ..database.database import Database
from ..database.frames import FrameSet
from ..database.index_search import IndexSearch
from ..database.metadata import ExtraDescriptor
from ..database.reading import Damage
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import find_image_files, read_image
from ..datasets.label_files import find_label_files, read_label_map
from ..datasets.names import KnownFolders
from ..encoding.results import Skipped, cores
from ..evaluation.metrics import Convention
from ..evaluation.report import Descriptors
from ..recognition.matching import Matches
from ..recognition.recognise import AS_PAPER, Recognised, Steps, recognise_by_search
from ..recognition.recognise import recognise as recognise_places
from ..recognition.standardise import MIN_FRAMES
from ..recognition.sweep import COLUMNS, score
from ..taxonomy import label_space
from ..untrusted import parse_yaml
from .measure import TOP, Recognition, wants_similarity
from .options import MethodOptions, RecognitionOptions, StepOptions
from .output import progress_bar
from .pictures import pictures_of_files, pictures_of_queries, pictures_of_references
from .report import CANDIDATES, Page
from .sources import LabelsAs, Source, encode_queries, load_references, settings_of
from .truth import Places

_AHEAD = 16


def steps_of(given: StepOptions) -> Steps:
    """The steps that the options ask for."""
    if isinstance(given, RecognitionOptions) and given.as_paper:
        return AS_PAPER
    follow = None if given.follow == "no" else given.follow
    return Steps(given.standardise, given.sweep, follow, given.delay)


def beside(database: Database, given: RecognitionOptions) -> tuple[ExtraDescriptor, ...]:
    """The further methods that describe queries: those of the database, unless told not to."""
    if given.fuse and not database.beside:
        raise ValueError(
            f"--fuse: {database.path} holds no descriptors of pictures; encode them anew with "
            "--with hog"
        )
    return () if given.fuse is False or given.as_paper else database.beside


class Found(NamedTuple):
    """What was found of the frames of a source in a database.

    Attributes:
        queries, references: the frames.
        recognised: the candidates of every query.
        temporal: t of Eq. 3, for each sequence if they differ.
        skipped: frames that could not be encoded.
        folders: of the sequences of the queries.
    """

    queries: FrameSet
    references: FrameSet
    recognised: Recognised
    temporal: int | dict[str, int]
    skipped: list[Skipped]
    folders: KnownFolders


def look_up(
    database: Database,
    source: Source,
    options: RecognitionOptions,
    top: int,
    steps: Steps | None = None,
    damage: list[Damage] | None = None,
    shut: Callable[[FrameSet, FrameSet], torch.Tensor | None] = lambda *_: None,
) -> Found:
    """The candidates of every frame of a source in a database.

    Args:
        database: of the references.
        source: of the queries.
        options: what is done with the descriptors.
        top: candidates of each query.
        steps: in place of those of the options; then the label maps alone are used.
        damage: as for `Database.load`.
        shut: from queries and references to ``(Q, R)`` bool, references that are no candidates.
    """
    also = () if steps else beside(database, options)
    steps = steps or steps_of(options)
    references, t = load_references(database, options.reach, damage)
    columns = COLUMNS if steps.sweep else ()
    queries, skipped, folders = encode_queries(database, source, columns, also)
    found = recognise_places(
        queries.descriptors,
        references.descriptors,
        queries.sequences,
        references.sequences,
        steps,
        top,
        shut(queries, references),
        {name: (values, references.beside[name]) for name, values in queries.beside.items()},
    )
    return Found(queries, references, found, t, skipped, folders)


def by_database(
    database: Database,
    source: Source,
    options: RecognitionOptions,
    convention: Convention,
    page: Page | None,
) -> Recognition:
    """The candidates of every query in a database, for a page if there is one. A convention that
    looks at all pairs uses their cosines, and no step is taken."""
    pairs = wants_similarity(convention)
    queries, references, found, t, skipped, folders = look_up(
        database, source, options, CANDIDATES if page else TOP, AS_PAPER if pairs else None
    )
    swept = queries.descriptors
    if swept.ndim == 3:
        usual = swept[:, COLUMNS.index(0)].contiguous()
        queries = dataclasses.replace(queries, descriptors=usual)
    config = settings_of(database, source.labels_as)
    given = page.pictures if page else ()
    similarity = None
    if pairs:
        similarity = score(queries.descriptors, references.descriptors).numpy()
    return Recognition(
        references=Places.of_set(references, source.whole, source.known),
        queries=Places.of_set(queries, source.whole, folders, [f.frame for f in skipped]),
        found=sure_enough(found, options.min_confidence),
        similarity=similarity,
        descriptors=Descriptors.of(queries.descriptors, references.descriptors, config),
        pictures=(
            pictures_of_queries(source, config.labels_as),
            pictures_of_references(database, source, given, config.labels_as),
        ),
        skipped=skipped,
        told={
            "preset": config.preset,
            "fingerprint": config.fingerprint,
            "temporal": t,
            "steps": found.used,
            "mean_confidence": float(found.confidence.mean()),
        },
    )


def look_up_by_index(
    database: Database,
    source: Source,
    options: RecognitionOptions,
    top: int,
    sequences: Sequence[str] | None,
    exclude: int | None,
) -> Found:
    """The same over the candidates of a database's index, without a sweep.

    Args:
        database, source, options, top: as for `look_up`.
        sequences: the only ones that candidates may be of, if given.
        exclude: so many frames on each side of a query in its own sequence are no candidates.
    """
    steps = steps_of(options)
    queries, skipped, folders = encode_queries(database, source)
    ids, names = queries.frames, queries.sequences

    @cache
    def search(standardised: bool) -> IndexSearch:
        return IndexSearch(
            database, queries.descriptors, names, standardised, sequences, (ids, exclude)
        )

    long = names.count(names[0]) >= MIN_FRAMES if names else False
    references = search(steps.standardise and long).frames
    found = recognise_by_search(search, names, references.sequences, steps, top)
    return Found(queries, references, found, 0, skipped, folders)


def sure_enough(found: Recognised, least: float) -> Matches:
    """The candidates of queries that are sure enough; the others have none."""
    unsure = (found.confidence < least)[:, None]
    scores, indices = found.matches
    return Matches(scores.masked_fill(unsure, -torch.inf), indices.masked_fill(unsure, -1))


def barred(
    queries: int,
    references: int,
    where: npt.NDArray[np.bool_] | None,
    exclude: npt.NDArray[np.int64] | None,
) -> torch.Tensor | None:
    """``(Q, R)`` bool, references that are no candidates; see `ssrvlad_torch.match`."""
    if where is None and exclude is None:
        return None
    shut = np.zeros((queries, references), np.bool_)
    if where is not None:
        shut |= ~where
    if exclude is not None:
        rows = np.arange(references)
        shut |= (rows >= exclude[:, :1]) & (rows < exclude[:, 1:])
    return torch.from_numpy(shut)


def by_method(
    given: MethodOptions,
    references: Path,
    source: Source,
    options: RecognitionOptions,
    convention: Convention,
    page: Page | None,
) -> Recognition:
    """The candidates of every query by another method; arguments as for `by_database`."""
    assert given.method is not None
    for name in given.named:
        if not takes(given.method, name):
            raise ValueError(f"method {given.method} takes no --{name.replace('_', '-')}")
    method = make(given.method, {**parse_settings(given.settings or ()), **given.named})
    labelled = "labels" in method.needs
    if labelled and source.labels_as is None:
        raise ValueError(f"method {method.name} reads label maps; expected their --labels-as")
    there = (find_label_files if labelled else find_image_files)([str(references)])
    source = dataclasses.replace(source, known={(f.folder, f.sequence) for f in there})
    here = source.label_files() if labelled else source.image_files()
    labels_as = source.labels_as if labelled else None
    all_pairs = wants_similarity(convention) or page is not None
    steps = None if wants_similarity(convention) else steps_of(options)
    workers = source.given.workers or cores()
    found = recognise(method, there, here, labels_as, workers, all_pairs, steps)[-1]
    pictures = pictures_of_files(here, labels_as), pictures_of_files(there, labels_as)
    return dataclasses.replace(found, pictures=pictures)


def make(name: str, settings: Mapping[str, Any]) -> baselines.Method:
    """A method with its settings."""
    try:
        return baselines.make(name, **settings)
    except TypeError as error:
        given = ", ".join(f"{key}={value!r}" for key, value in settings.items())
        raise ValueError(f"method {name} cannot take {given}: {error}") from error


def takes(name: str, setting: str) -> bool:
    """Whether a method has a setting of this name."""
    return setting in signature(baselines.class_of(name)).parameters


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """``NAME=VALUE`` pairs; values are read as YAML."""
    settings = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"--set wants NAME=VALUE, got {pair!r}")
        settings[name] = parse_yaml(value, f"the value of --set {name}")
    return settings


def recognise(
    method: baselines.Method,
    references: Sequence[FrameFile],
    queries: Sequence[FrameFile],
    labels_as: LabelsAs | None,
    workers: int,
    all_pairs: bool,
    steps: Steps | None = None,
) -> list[Recognition]:
    """The candidates of every query, by any method: of single frames, and after the steps if any.

    Args:
        method: reads the files, which are label maps or images as it needs.
        labels_as: label space of the label maps; ``None`` for images.
        workers: threads that read ahead.
        all_pairs: whether the scores of all pairs are needed.
        steps: what is done between encodings and a decision.
    """
    with progress_bar(method.name, len(references) + len(queries)) as bar:
        retrieval = run(
            method,
            _frames(queries, labels_as, workers),
            _frames(references, labels_as, workers),
            top=max(TOP, len(references)) if all_pairs else TOP,
            progress=bar.advance,
            steps=steps,
        )
    found = Matches(retrieval.scores, retrieval.indices)
    single = Recognition(
        references=Places.of(references),
        queries=Places.of(queries),
        found=found,
        similarity=unranked(found, len(references)) if all_pairs else None,
        told={
            "method": method.name,
            "temporal": getattr(method, "temporal", None),
            "steps": None,
            "encode_ms": dataclasses.asdict(retrieval.encode),
            "match_ms": dataclasses.asdict(retrieval.match),
            "bytes_a_reference": retrieval.bytes_a_reference,
        },
    )
    stepped = retrieval.stepped
    if stepped is None:
        return [single]
    told = {**single.told, "steps": stepped.used}
    return [single, dataclasses.replace(single, found=stepped.matches, told=told)]


def _frames(
    files: Sequence[FrameFile], labels_as: LabelsAs | None, workers: int
) -> Iterator[baselines.Frame]:
    """Frames with their label maps, or, without a label space, with their images."""
    space = label_space(labels_as) if labels_as else None
    name = labels_as if isinstance(labels_as, str) else space.name if space else None

    def load(file: FrameFile) -> baselines.Frame:
        if space:
            return baselines.Frame(file.frame, read_label_map(file, space), name)
        return baselines.Frame(file.frame, image=read_image(file))

    for file, frame in read_ahead(load, files, workers, _AHEAD):
        if isinstance(frame, ValueError):
            raise ValueError(f"{file.path}: {frame}") from frame
        yield frame


def unranked(found: Matches, references: int) -> npt.NDArray[np.float32]:
    """Scores of all pairs, ``(Q, R)``, of queries whose candidates are all references."""
    scores = found.scores.new_full((len(found.scores), references), -torch.inf)
    rows, ranks = (found.indices >= 0).nonzero(as_tuple=True)
    scores[rows, found.indices[rows, ranks]] = found.scores[rows, ranks]
    similarity: npt.NDArray[np.float32] = scores.numpy()
    return similarity
