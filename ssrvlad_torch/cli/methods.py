"""Running another method of `ssrvlad_torch.baselines` on frames on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from inspect import signature
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import yaml

from .. import baselines
from ..baselines.run import Retrieval, run
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import read_image
from ..datasets.label_files import read_label_map
from ..recognition.matching import Matches
from ..taxonomy import label_space
from .measure import TOP, Recognition
from .output import progress_bar
from .truth import Places

_AHEAD = 16


def make(name: str, settings: Mapping[str, Any]) -> baselines.Method:
    """A method with its settings.

    Raises:
        ValueError: no such method, or settings that it does not take.
        OSError: its weights are not there.
    """
    try:
        return baselines.make(name, **settings)
    except TypeError as error:
        given = ", ".join(f"{key}={value!r}" for key, value in settings.items())
        raise ValueError(f"method {name} cannot take {given}: {error}") from error


def takes(name: str, setting: str) -> bool:
    """Whether a method has a setting of this name.

    Raises:
        ValueError: no such method.
    """
    if name not in baselines.METHODS:
        raise ValueError(f"unknown method {name!r}; wanted one of {', '.join(baselines.METHODS)}")
    module, noun = baselines.METHODS[name]
    method = getattr(import_module(f"..baselines.{module}", __package__), noun)
    return setting in signature(method).parameters


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """``NAME=VALUE`` pairs; values are read as YAML.

    Raises:
        ValueError: a pair without ``=`` or with a value that is no YAML.
    """
    settings = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"--set wants NAME=VALUE, got {pair!r}")
        try:
            settings[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ValueError(f"--set {name} wants a value in YAML, got {value!r}") from error
    return settings


def recognise(
    method: baselines.Method,
    references: Sequence[FrameFile],
    queries: Sequence[FrameFile],
    labels_as: str | None,
    workers: int,
    all_pairs: bool,
) -> Recognition:
    """The candidates of every query, by any method.

    Args:
        method: what reads the files: label maps or images, as it needs.
        labels_as: label space of the label maps; of images ``None``.
        workers: threads that read ahead.
        all_pairs: whether the scores of all pairs are wanted.

    Raises:
        ValueError: a frame cannot be read, or the method refuses it; the message names it.
    """
    with progress_bar(method.name, len(references) + len(queries)) as advance:
        retrieval = run(
            method,
            _frames(queries, labels_as, workers),
            _frames(references, labels_as, workers),
            top=max(TOP, len(references)) if all_pairs else TOP,
            progress=advance,
        )
    found = Matches(retrieval.scores, retrieval.indices)
    return Recognition(
        references=Places.of(references),
        queries=Places.of(queries),
        found=found,
        similarity=_unranked(found, len(references)) if all_pairs else None,
        told={"method": method.name, **_costs(retrieval)},
    )


def _frames(
    files: Sequence[FrameFile], labels_as: str | None, workers: int
) -> Iterator[baselines.Frame]:
    """Frames with their label maps, or, without a label space, with their images."""
    space = label_space(labels_as) if labels_as else None

    def load(file: FrameFile) -> baselines.Frame:
        if space:
            return baselines.Frame(file.frame, read_label_map(file, space), labels_as)
        return baselines.Frame(file.frame, image=read_image(file))

    for file, frame in read_ahead(load, files, workers, _AHEAD):
        if isinstance(frame, ValueError):
            raise ValueError(f"{file.path}: {frame}") from frame
        yield frame


def _unranked(found: Matches, references: int) -> npt.NDArray[np.float32]:
    """Scores of all pairs, ``(Q, R)``, from as many candidates at least."""
    scores = found.scores.new_full((len(found.scores), references), -torch.inf)
    rows, ranks = (found.indices >= 0).nonzero(as_tuple=True)
    scores[rows, found.indices[rows, ranks]] = found.scores[rows, ranks]
    similarity: npt.NDArray[np.float32] = scores.numpy()
    return similarity


def _costs(retrieval: Retrieval) -> dict[str, Any]:
    return {
        "encode_ms": dataclasses.asdict(retrieval.encode),
        "match_ms": dataclasses.asdict(retrieval.match),
        "bytes_a_reference": retrieval.bytes_a_reference,
    }
