"""The content of the page of an evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ...config import AREA_LAYERS, SSRVLADConfig
from ...recognition.sweep import score
from ...stages.boundaries import DIRECTIONS
from ...taxonomy import CATEGORIES
from ..curves import PrecisionRecall
from ..outcomes import Outcomes, Rows, Truth
from .images import Pixels


class Frames(Protocol):
    """Frames with their poses, for example a `FrameSet`."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Ids, ``<sequence>/<name>``."""

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)``, x and y in metres first, NaN where unknown."""


class Picture(NamedTuple):
    """Pictures of a frame, ``(H, W, 3)`` uint8 RGB, ``None`` where not available.

    Attributes:
        labels: the label map in colours.
        photo: the image that was segmented.
    """

    labels: Pixels | None = None
    photo: Pixels | None = None


Pictures = Callable[[str], Picture]
"""A function from a frame's id to its pictures; it reads files only when it is called."""


Scores = Callable[[Rows, Rows], npt.NDArray[np.floating[Any]]]
"""A function from rows of n queries and m references to the scores ``(n, m)`` of their pairs, -inf
for pairs that cannot match."""


class Descriptors(NamedTuple):
    """Descriptors and the layout of their parts.

    Attributes:
        queries: ``(Q, D)`` float.
        references: ``(R, D)`` float, as they were matched.
        parts: lengths of the parts in order, by name; their sum is D.
    """

    queries: Tensor
    references: Tensor
    parts: Mapping[str, int]

    @classmethod
    def of(cls, queries: Tensor, references: Tensor, config: SSRVLADConfig) -> Descriptors:
        """Descriptors that were computed with ``config``."""
        if config.aggregation == "harmonics":
            areas = dict.fromkeys(CATEGORIES[:AREA_LAYERS], config.harmonics)
            names = (f"{direction} boundaries" for direction in DIRECTIONS)
            parts = {**areas, **dict.fromkeys(names, config.boundary_harmonics)}
        else:
            parts = dict.fromkeys(CATEGORIES, config.length // len(CATEGORIES))
        return cls(queries, references, parts)


@dataclass(frozen=True)
class Report:
    """An evaluation. Texts may hold any characters; the page escapes them.

    Attributes:
        title: title of the page.
        metrics: result of `metrics.evaluate` with intervals, with the additional keys
            ``thresholds`` from `operating_points` and ``references``, as ``evaluate --json`` prints
            it.
        queries, references: the frames, Q and R of them.
        outcomes: outcomes of the queries.
        truth: true matches of each query.
        candidates: number of candidates of each query; RecallRate@N is drawn up to this N.
        curve: precision and recall by the convention of the metrics.
        scores: scores of the pairs of queries and references.
        descriptors: for the contribution of each part to a cosine; ``None`` without descriptors.
        query_pictures, reference_pictures: pictures of the frames.
        settings: names and values of the settings of the evaluation.
        notes: warnings, one per line.
    """

    title: str
    metrics: Mapping[str, Any]
    queries: Frames
    references: Frames
    outcomes: Outcomes
    truth: Truth
    candidates: int
    curve: PrecisionRecall
    scores: Scores
    descriptors: Descriptors | None = None
    query_pictures: Pictures = lambda _: Picture()
    reference_pictures: Pictures = lambda _: Picture()
    settings: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()


def cosine_scores(queries: Tensor, references: Tensor) -> Scores:
    """Cosines of descriptors ``(Q, D)`` and ``(R, D)``, -inf where a descriptor is zero."""
    return lambda rows, columns: score(
        queries[torch.from_numpy(rows)], references[torch.from_numpy(columns)]
    ).numpy()


def stored_scores(similarity: npt.NDArray[np.floating[Any]]) -> Scores:
    """Scores from a matrix ``(Q, R)`` of all pairs."""
    return lambda rows, columns: similarity[np.ix_(rows, columns)]
