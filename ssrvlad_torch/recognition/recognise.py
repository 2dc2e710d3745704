"""Recognise: from descriptors of queries and of a map to places, with a confidence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..native.map import Decision, DescriptorMap
from .matching import Matches, Vectors, candidates_table, checked_number, real_tensor
from .sequences import MIN_FRAMES
from .sweep import COLUMNS

FORWARDS, BACKWARDS = 1, -1
"""Ways to run a map."""


@dataclass(frozen=True)
class Steps:
    """What is done between descriptors and a decision.

    Attributes:
        standardise: subtract the mean of each sequence, see `sequences`. A sequence of fewer
            than `sequences.MIN_FRAMES` queries, and the references for it, stay raw; so does all
            for a map of fewer references.
        sweep: use all anchors of queries that have several, see `sweep`.
        follow: place each query by the queries before it (online) or by all (offline) of its
            sequence, with a hidden Markov model; ``None`` judges each query alone. A
            sequence is judged so too where following does not make its answers surer.
        delay: number of later queries that an online answer waits for.

    Raises:
        ValueError: ``follow`` is none of these, the delay is no whole number from 0, or there
            is a delay and ``follow`` is not online.
    """

    standardise: bool = True
    sweep: bool = True
    follow: Literal["online", "offline"] | None = "offline"
    delay: int = 0

    def __post_init__(self) -> None:
        if self.follow not in (None, "online", "offline"):
            raise ValueError(f"follow: expected online, offline or None, got {self.follow!r}")
        object.__setattr__(self, "delay", checked_number("delay", self.delay, least=0))
        if self.delay and self.follow != "online":
            raise ValueError(
                f"delay: expected 0, or more with follow online, got {self.delay} with "
                f"{self.follow or 'no'}"
            )


AS_PAPER = Steps(standardise=False, sweep=False, follow=None)


class Course(NamedTuple):
    """How queries run a map: `FORWARDS` or `BACKWARDS`, at a rate in rows of the map a
    frame, and as how many streams whose frames alternate."""

    way: int = FORWARDS
    rate: float = 1
    streams: int = 1

    def __str__(self) -> str:
        words = (
            "backwards" * (self.way == BACKWARDS),
            f"at rate {self.rate:g}" * (self.rate != 1),
            f"{self.streams} streams in turn" * (self.streams != 1),
        )
        return ", ".join(filter(None, words))


class Confidence(NamedTuple):
    """How sure the answers to queries are, see docs/concepts/equations.md.

    Of wrong answers ``-log(chance)`` is exponential, of right ones gamma with a larger mean; where
    the map lacks the place all answers are wrong, and a hidden Markov chain says where.

    Attributes:
        right: ``(Q,)`` float32, the probability that the first candidate is right; 0 without one,
            and where the map has too few references to say.
        spread: ``(Q,)`` float32, standard deviation of ``right``, as far as the sequence does not
            show how often such answers are right.
        together: ``(Q,)`` float32, how many neighbouring queries err together; 0 without a
            candidate, and only there.
    """

    right: Tensor
    spread: Tensor
    together: Tensor


class Recognised(NamedTuple):
    """The candidates of all queries.

    Attributes:
        matches: ``(Q, top)``. Scores of a query that is judged alone are cosines. Scores of a query
            that is followed are probabilities: for the first candidate that of the rows within
            `sequences.SAME_PLACE_ROWS`, for the others that of the row alone. An empty query has no
            candidate.
        sure: how sure the first candidates are; all 0 with fewer than `sequences.MIN_FRAMES`
            references.
        used: the steps as a report: `Steps` and the number of references, and by sequence whether
            it was standardised, the width of its sweep, in words how it was followed, and the
            weights of fused channels.
        courses: by sequence, how it runs the map if it was followed.
        follows: ``(Q,)`` bool, whether each query was followed.
        score_is: what the scores of each query are, see `score_is`.
        settled: ``(Q,)`` bool, online whether `sequences.MIN_FRAMES` queries of its sequence came
            before; else all.
    """

    matches: Matches
    sure: Confidence
    used: dict[str, Any]
    courses: dict[str, Course | None]
    follows: Tensor
    score_is: list[str]
    settled: Tensor

    @property
    def confidence(self) -> Tensor:
        """``(Q,)`` float32, the probability that the first candidate is right; see `Confidence`."""
        return self.sure.right

    def _repr_html_(self) -> str:
        return candidates_table(*self.matches, confidence=self.confidence)


def score_is(followed: bool, fused: bool) -> str:
    """What the scores of the candidates of a query are: probabilities if it was followed, else
    fused scores if several channels judged it, or cosines."""
    return "probability" if followed else "fused score" if fused else "cosine"


def runs(sequences: Sequence[str]) -> Iterator[range]:
    """Rows of each sequence; rows of one that do not stand together are a ValueError."""
    first, names = 0, set[str]()
    for sequence, rows in groupby(sequences):
        if sequence in names:
            raise ValueError(f"expected the frames of {sequence!r} together, got some at {first}")
        names.add(sequence)
        last = first + len(list(rows))
        yield range(first, last)
        first = last


def references_of(
    channels: Mapping[str, Vectors | None],
    sequences: Sequence[str],
    trust: Mapping[str, float] | None = None,
) -> DescriptorMap:
    """The frames of a map as `recognise` compares them. The arrays must not change.

    Args:
        channels: by their names vectors ``(R, D)`` float, of length 1 or zero for an empty frame,
            or signs ``(R, columns, rows, bytes)`` uint8, eight in a byte; ``None`` for scores.
        sequences: of the frames, which stand together and in order; else a ValueError.
        trust: how much channels count before anything is known of the queries, by default 1.
    """
    town = DescriptorMap([*map(len, runs(sequences))])
    for name, rows in channels.items():
        town.add(name, None if rows is None else _array(rows), (trust or {}).get(name, 1.0))
    return town


def _array(rows: Vectors) -> npt.NDArray[Any]:
    """Vectors as float32, signs as they are; others than real numbers in memory are a
    ValueError."""
    tensor = real_tensor(rows)
    array: npt.NDArray[Any] = (tensor if tensor.dtype == torch.uint8 else tensor.float()).numpy(
        force=True
    )
    return array


@torch.no_grad()
def recognise(
    queries: Mapping[str, Vectors],
    query_sequences: Sequence[str],
    references: DescriptorMap | Callable[[slice], DescriptorMap],
    steps: Steps | None = None,
    top: int = 5,
    allowed: npt.NDArray[np.bool_] | None = None,
    excluded: npt.NDArray[np.int64] | None = None,
) -> Recognised:
    """Candidates of each query, and the confidence in the first. Each sequence of queries is one
    call of the native core, which fuses the channels of the map.

    Args:
        queries: raw descriptors of all by each channel of the map, in its order.
        query_sequences: the sequence of each; the frames of one stand together and in order.
        references: the frames of the map, see `references_of`, or what shortlists those for the
            queries of one sequence.
        steps: what is done; without, all steps.
        top: number of candidates of each query.
        allowed: ``(R,)`` bool, references that may be candidates; by default all.
        excluded: ``(Q, 2)`` int64, of each query the first of some references that may not, and the
            one after the last.

    Raises:
        ValueError: shapes do not fit.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.recognition.recognise import recognise, references_of
        >>> frames = torch.eye(20)
        >>> references = references_of({"x": frames}, ["b"] * 20)
        >>> recognise({"x": frames[5:9]}, ["a"] * 4, references).matches.indices[:, 0].tolist()
        [5, 6, 7, 8]
    """
    steps, top = steps or Steps(), checked_number("top", top, least=1)
    arrays = {name: _array(values) for name, values in queries.items()}
    for name, array in arrays.items():
        if len(array) != len(query_sequences):
            raise ValueError(
                f"expected a sequence for each of {len(array)} queries, got {len(query_sequences)}"
            )
        swept = steps.sweep and array.ndim == 3 and array.dtype.kind == "f"
        if swept and array.shape[1] != len(COLUMNS):
            raise ValueError(
                f"{name}: expected (Q, {len(COLUMNS)}, D) for columns {COLUMNS}, got {array.shape}"
            )
    decisions: dict[str, Decision] = {}
    count = 0 if callable(references) else references.frames
    for run in runs(query_sequences):
        rows = slice(run.start, run.stop)
        town = references(rows) if callable(references) else references
        count = town.frames
        decisions[query_sequences[run.start]] = town.query(
            {name: array[rows] for name, array in arrays.items()},
            steps.standardise,
            steps.sweep,
            steps.follow if len(run) > 1 else None,
            steps.delay,
            top,
            torch.get_num_threads(),
            allowed,
            None if excluded is None else excluded[rows],
        )
    return _joined(decisions, count, steps, top)


def recognise_by_scores(
    scores: Tensor,
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
) -> Recognised:
    """As `recognise`, by scores ``(Q, R)`` float, at most 1, -inf where there can be no match. For
    methods whose encodings are no vectors; following is the only step. Frames of a map need not
    stand together for queries that are judged alone."""
    steps = replace(steps or Steps(), standardise=False, sweep=False)
    sequences = reference_sequences if steps.follow else [""] * len(reference_sequences)
    references = references_of({"scores": None}, sequences)
    return recognise({"scores": scores}, query_sequences, references, steps, top)


def _joined(
    decisions: Mapping[str, Decision], references: int, steps: Steps, top: int
) -> Recognised:
    """The decisions about all sequences of queries, by their names, as one."""
    courses = dict[str, Course | None]()
    used: dict[str, Any] = {**asdict(steps), "references": references}
    used |= {"standardise": {}, "sweep": {}, "follow": {}, "weights": {}}
    for name, decision in decisions.items():
        course, words = None, "no, following is no surer" if steps.follow else "no"
        if decision.follows.any():
            course = Course(decision.way, decision.rate, decision.streams)
            words = ", ".join(filter(None, (steps.follow, str(course))))
        taken, courses[name] = decision.taken, course
        used["follow"][name], used["standardise"][name] = words, taken.standardised
        used["sweep"][name] = COLUMNS[len(COLUMNS) // 2 + taken.width]
        used["weights"][name] = taken.weights if len(taken.weights) > 1 else {}

    def column(name: str, kind: Any, *shape: int) -> Tensor:
        """Of all queries, also if there are none."""
        columns = map(attrgetter(name), decisions.values())
        return torch.from_numpy(np.concatenate([np.zeros((0, *shape), kind), *columns]))

    matches = Matches(column("scores", np.float32, top), column("rows", np.int64, top))
    together = column("together", np.float32).masked_fill(matches.indices[:, 0] < 0, 0)
    confidence = Confidence(column("right", np.float32), column("spread", np.float32), together)
    follows, fused = column("follows", bool), any(used["weights"].values())
    kinds = [score_is(followed, fused) for followed in follows.tolist()]
    settled = torch.ones_like(follows)
    if steps.follow == "online":
        numbers = [n for decision in decisions.values() for n in range(len(decision.follows))]
        settled = torch.tensor(numbers, dtype=torch.int64) >= MIN_FRAMES
    return Recognised(matches, confidence, used, courses, follows, kinds, settled)
