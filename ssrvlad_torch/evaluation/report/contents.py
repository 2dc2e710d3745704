"""What an evaluation's page is made of."""

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
    """Frames, and where they were taken; a `FrameSet` is one."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Ids, ``<sequence>/<name>``."""

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)``, x and y in metres first, NaN where unknown."""


class Picture(NamedTuple):
    """What is known of how a frame looks, ``(H, W, 3)`` uint8 RGB each.

    Attributes:
        labels: its label map in colours.
        photo: the image that was labelled.
    """

    labels: Pixels | None = None
    photo: Pixels | None = None


Pictures = Callable[[str], Picture]
"""From a frame's id to its picture; no file is looked for before it is called."""


Scores = Callable[[Rows, Rows], npt.NDArray[np.floating[Any]]]
"""From rows of n queries and of m references to the ``(n, m)`` scores of all their pairs, -inf
where there can be no match."""


class Descriptors(NamedTuple):
    """Descriptors, and what they are made of.

    Attributes:
        queries: ``(Q, D)`` float.
        references: ``(R, D)`` float, as they were matched.
        parts: lengths of the parts in their order, by their names; D in all.
    """

    queries: Tensor
    references: Tensor
    parts: Mapping[str, int]

    @classmethod
    def of(cls, queries: Tensor, references: Tensor, config: SSRVLADConfig) -> Descriptors:
        """Descriptors of some settings."""
        if config.aggregation == "harmonics":
            areas = dict.fromkeys(CATEGORIES[:AREA_LAYERS], config.harmonics)
            names = (f"{direction} boundaries" for direction in DIRECTIONS)
            parts = {**areas, **dict.fromkeys(names, config.boundary_harmonics)}
        else:
            parts = dict.fromkeys(CATEGORIES, config.length // len(CATEGORIES))
        return cls(queries, references, parts)


@dataclass(frozen=True)
class Report:
    """An evaluation. All texts are shown as they are, whatever characters they hold.

    Attributes:
        title: what was evaluated.
        metrics: from `metrics.evaluate` with intervals, and beside them ``thresholds`` from
            `operating_points` and ``references``; what ``evaluate --json`` prints will do.
        queries, references: the frames, Q and R of them.
        outcomes: of the queries.
        truth: true matches of each query.
        candidates: how many of each query the outcomes were judged from; RecallRate@N is drawn up
            to here.
        curve: precision and recall by the convention of the metrics.
        scores: of the pairs of queries and references.
        descriptors: for what each part adds to a cosine; ``None`` where there are none.
        query_pictures, reference_pictures: what is known of how frames look.
        settings: names and values that say how it was done.
        notes: warnings, a line each.
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
    """Cosines of descriptors ``(Q, D)`` and ``(R, D)``, -inf where one is zero: what is empty
    matches nothing."""
    return lambda rows, columns: score(
        queries[torch.from_numpy(rows)], references[torch.from_numpy(columns)]
    ).numpy()


def stored_scores(similarity: npt.NDArray[np.floating[Any]]) -> Scores:
    """Scores from a matrix ``(Q, R)``."""
    return lambda rows, columns: similarity[np.ix_(rows, columns)]
