"""Other methods, run on the files of references and queries."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from inspect import signature
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import baselines
from ..baselines.run import run
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import read_image
from ..datasets.label_files import read_label_map
from ..files import parse_yaml
from ..recognition.matching import Matches
from ..recognition.recognise import Steps
from ..taxonomy import label_space
from .measure import TOP, Recognition
from .output import progress_bar
from .sources import LabelsAs
from .truth import Places

_AHEAD = 16


def make(name: str, settings: Mapping[str, Any]) -> baselines.Method:
    """A method with its settings."""
    try:
        return baselines.make(name, **settings)
    except TypeError as error:
        values = ", ".join(f"{key}={value!r}" for key, value in settings.items())
        raise ValueError(f"method {name} cannot take {values}: {error}") from error


def has_setting(name: str, setting: str) -> bool:
    """Whether a method has a setting of this name."""
    return setting in signature(baselines.class_of(name)).parameters


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """The settings of ``NAME=VALUE`` pairs; values are read as YAML."""
    settings = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"--set: expected NAME=VALUE, got {pair!r}")
        settings[name] = parse_yaml(value, f"the value of --set {name}")
    return settings


def run_method(
    method: baselines.Method,
    references: Sequence[FrameFile],
    queries: Sequence[FrameFile],
    labels_as: LabelsAs | None,
    workers: int,
    all_pairs: bool,
    steps: Steps | None = None,
) -> list[Recognition]:
    """The candidates of every query: of single frames, and, if steps are given, after the steps.

    Args:
        method: reads label maps or images.
        references, queries: files of label maps or images, as the method needs.
        labels_as: label space of the label maps; ``None`` for images.
        workers: threads that read ahead.
        all_pairs: whether the scores of all pairs are needed.
        steps: between encodings and a decision.
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
    matches = Matches(retrieval.scores, retrieval.indices)
    single = Recognition(
        references=Places.of(references),
        queries=Places.of(queries),
        matches=matches,
        similarity=similarity_of(matches, len(references)) if all_pairs else None,
        details={
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
    details = {**single.details, "steps": stepped.used}
    return [single, dataclasses.replace(single, matches=stepped.matches, details=details)]


def similarity_of(matches: Matches, references: int) -> npt.NDArray[np.float32]:
    """Scores of all pairs, ``(Q, R)``, from matches that rank all references."""
    scores = matches.scores.new_full((len(matches.scores), references), -np.inf)
    rows, ranks = (matches.indices >= 0).nonzero(as_tuple=True)
    scores[rows, matches.indices[rows, ranks]] = matches.scores[rows, ranks]
    similarity: npt.NDArray[np.float32] = scores.numpy()
    return similarity


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
