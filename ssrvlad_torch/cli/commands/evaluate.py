"""``ssrvlad evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from ... import baselines
from ...database.database import Database, FrameSet
from ...datasets.dataset import shortened
from ...datasets.image_files import find_image_files
from ...datasets.label_files import find_label_files
from ...evaluation.metrics import Convention
from ...recognition.matching import match
from .. import options
from ..measure import TOP, Recognition, measure, print_metrics, wants_similarity
from ..methods import make, parse_settings, recognise, takes
from ..options import Choosing, Segmenting, Selection
from ..output import finish, print_json
from ..pictures import pictures_of_files, pictures_of_queries, pictures_of_references
from ..report import CANDIDATES, Page
from ..sources import Source, load, with_labels_as
from ..truth import Places, TrueMatches, counted

TEMPORAL = 3


@dataclass(frozen=True)
class Rival:
    """Another method, and its settings as they were typed."""

    name: str | None
    pairs: Sequence[str]
    weights: Path | None
    vocabulary: Path | None
    random_weights: bool

    @property
    def options(self) -> dict[str, Any]:
        """The settings that have an option of their own, those that were given."""
        given = {
            "weights": self.weights,
            "vocabulary": self.vocabulary,
            "random_weights": self.random_weights,
        }
        return {name: value for name, value in given.items() if value}


def evaluate(
    database: Annotated[
        Path, typer.Argument(help="Folder of the database; with --method, of the references.")
    ],
    source: options.Sources,
    labels_as: options.MaybeLabelsAs = None,
    method: Annotated[
        str | None,
        typer.Option(
            help=f"Another method, on label maps or images as it needs: "
            f"{', '.join(baselines.METHODS)}."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting of the method, NAME=VALUE; repeatable."),
    ] = None,
    weights: options.Weights = None,
    vocabulary: Annotated[
        Path | None, typer.Option(help="Vocabulary of the method, see ssrvlad vocabulary.")
    ] = None,
    random_weights: options.RandomWeights = False,
    ground_truth: options.TruthFile = None,
    tolerance_metres: options.Metres = None,
    tolerance_degrees: options.Degrees = None,
    tolerance_frames: options.FrameCount = None,
    convention: options.ConventionName = "exact",
    at_recall: Annotated[
        float, typer.Option(min=0, max=1, help="Recall at which the precision is told.")
    ] = 0.5,
    temporal: Annotated[
        int | None,
        typer.Option(
            min=0, help="t of Eq. 3: reference frames summed on each side; 3 if not given."
        ),
    ] = None,
    layout: options.LayoutName = None,
    split: options.Splits = None,
    role: options.RoleName = None,
    labels: options.LabelsFolder = None,
    sequence: options.SequenceName = None,
    every: options.Every = 1,
    start: options.Start = 0,
    segmenter: options.SegmenterFile = None,
    segmenter_cache: options.SegmenterCache = None,
    workers: options.Workers = 2,
    as_json: options.Json = False,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Page to write (.html): the figures, curves, the similarity matrix, and matches "
            "with their pictures."
        ),
    ] = None,
    pictures: Annotated[
        list[str] | None,
        typer.Option(
            help="With --report: where label maps of the references are, for their pictures; "
            "repeatable. If not given, they are looked for in the data set or beside SOURCE."
        ),
    ] = None,
) -> None:
    """Measure the recognition: RecallRate@N, AUC-PR, Recall@100%Precision and more, with 95 %
    bootstrap intervals, and what follows from the choice of a threshold. The suggested one is the
    lowest whose precision is at least 0.95 at the lower end of its own 95 % interval.

    With --method it is another method that is measured, from the frames themselves.

    Example: ssrvlad evaluate town.ssrdb maps/today --tolerance-metres 5

    Example: ssrvlad evaluate photos/monday photos/today --method hog --tolerance-metres 5
    """
    rival = Rival(method, settings or (), weights, vocabulary, random_weights)
    _check(rival, temporal, layout, segmenter)
    page = _page(report, pictures, rival)
    opened = Source.open(
        source,
        labels_as,
        Choosing(layout, split, role, labels),
        Selection(sequence, every, start),
        Segmenting(segmenter, segmenter_cache),
        workers,
    )
    limits = (ground_truth, tolerance_metres, tolerance_degrees, tolerance_frames)
    truth = TrueMatches.by(*limits, opened.dataset.truth if opened.dataset else None)
    t = TEMPORAL if temporal is None else temporal
    if rival.name is None:
        if truth.metres is not None:
            opened = opened.posed()
        recognition = _by_database(database, opened, t, convention, page)
    else:
        recognition = _by_method(rival, database, opened, convention, page)
    matches = truth.among(recognition.references, recognition.queries)
    metrics = measure(recognition, matches, convention, at_recall)
    if as_json:
        print_json(metrics)
    else:
        print_metrics(metrics)
    if page:
        names = shortened([Path(place).name or place for place in source])
        title = f"{names} against {database.name or database}"
        told = {"references": str(database), "queries": shortened(source)}
        told["true matches"] = truth.words
        if rival.name is None:
            told["preset"] = Database.open(database).config.preset
            told["temporal sum"] = f"{t} frames on each side"
        page.write(recognition, matches, metrics, title, told)
        if not as_json:
            print(f"report: {page.path}")
    finish(recognition.refused)


def _check(rival: Rival, temporal: int | None, layout: str | None, segmenter: Path | None) -> None:
    """Refuses options that do not go together, and names what to use instead."""
    if rival.name is None:
        if rival.pairs or rival.options:
            name = "--set" if rival.pairs else _option(next(iter(rival.options)))
            raise ValueError(f"{name} wants a --method")
        return
    if temporal is not None:
        raise ValueError(
            f"--temporal is of a database; with --method ssr-vlad use --set temporal={temporal}"
        )
    if segmenter is not None:
        raise ValueError(
            "--segmenter does not go with --method: encode a database with it and evaluate that, "
            "or give a method of label maps the folder of a network's label maps"
        )
    if layout is not None:
        raise ValueError(
            "--layout does not go with --method: use ssrvlad compare, or name the two folders"
        )


def _page(report: Path | None, pictures: Sequence[str] | None, rival: Rival) -> Page | None:
    if pictures and (report is None or rival.name):
        raise ValueError("--pictures wants a --report of a database")
    return None if report is None else Page(report, pictures or ())


def _by_database(
    database: Path, source: Source, temporal: int, convention: Convention, page: Page | None
) -> Recognition:
    references, queries, refused = load(database, source, temporal)
    names = [refusal.frame for refusal in refused]
    config = with_labels_as(Database.open(database).config, source.labels_as)
    return Recognition(
        references=_places(references, counted(references.frames, source.whole)),
        queries=_places(queries, counted(queries.frames, source.whole, names)),
        found=match(queries.descriptors, references.descriptors, CANDIDATES if page else TOP),
        similarity=_similarity(queries, references) if wants_similarity(convention) else None,
        descriptors=(queries.descriptors, references.descriptors),
        pictures=(
            pictures_of_queries(source, config.labels_as),
            pictures_of_references(
                database, source, page.pictures if page else (), config.labels_as
            ),
        ),
        refused=refused,
        told={"fingerprint": config.fingerprint},
    )


def _by_method(
    rival: Rival, references: Path, source: Source, convention: Convention, page: Page | None
) -> Recognition:
    assert rival.name is not None
    for name in rival.options:
        if not takes(rival.name, name):
            raise ValueError(f"method {rival.name} takes no {_option(name)}")
    method = make(rival.name, {**parse_settings(rival.pairs), **rival.options})
    labelled = "labels" in method.needs
    if labelled and source.labels_as is None:
        raise ValueError(f"method {method.name} reads label maps; wanted their --labels-as")
    there = (find_label_files if labelled else find_image_files)([str(references)])
    here = source.label_files() if labelled else source.image_files()
    labels_as = source.labels_as if labelled else None
    all_pairs = wants_similarity(convention) or page is not None
    recognition = recognise(method, there, here, labels_as, source.workers, all_pairs)
    pictures = pictures_of_files(here, labels_as), pictures_of_files(there, labels_as)
    return replace(recognition, pictures=pictures)


def _places(frames: FrameSet, counted: tuple[str, ...]) -> Places:
    return Places(frames.frames, frames.poses, counted)


def _similarity(queries: FrameSet, references: FrameSet) -> npt.NDArray[np.float32]:
    """Cosines of all pairs, ``(Q, R)``; -inf where a frame is empty and matches nothing."""
    cosines: npt.NDArray[np.float32] = (queries.descriptors @ references.descriptors.T).numpy()
    cosines[queries.empty] = -np.inf
    cosines[:, references.empty] = -np.inf
    return cosines


def _option(setting: str) -> str:
    return "--" + setting.replace("_", "-")
