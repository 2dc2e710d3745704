"""Recognise: from descriptors of queries and of a map to places, with a confidence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from ..native.decide import Scores, Search
from . import deciding
from .comparison import Member
from .confidence import Confidence
from .display import candidates_table
from .fusion import fused_scores
from .matching import Matches, checked_excluded, checked_number
from .motion import Course
from .sequences import runs
from .standardise import MIN_FRAMES


@dataclass(frozen=True)
class Steps:
    """What is done between descriptors and a decision.

    Attributes:
        standardise: subtract the mean of each traverse, see `standardise`. A traverse of fewer
            than `standardise.MIN_FRAMES` queries, and the references for it, stay raw; so does all
            for a map of fewer references.
        sweep: use all anchors of queries that have several, see `sweep`.
        follow: place each query by the queries before it (online) or by all (offline) of its
            sequence, with a hidden Markov model, see `reference.Model`; ``None`` judges each query
            alone. A sequence is judged so too where following does not make its answers surer, see
            `reference.course`.
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


class Recognised(NamedTuple):
    """The candidates of all queries.

    Attributes:
        matches: ``(Q, top)``. Scores of a query that is judged alone are cosines. Scores of a query
            that is followed are probabilities: for the first candidate that of the rows within
            `motion.NEAR`, for the others that of the row alone. An empty query has no
            candidate.
        sure: how sure the first candidates are; all 0 with fewer than `standardise.MIN_FRAMES`
            references.
        used: the steps as a report: `Steps` and the number of references, and by sequence whether
            it was standardised, the width of its sweep, in words how it was followed, and the
            weights of fused channels.
        courses: by sequence, how it runs the map if it was followed.
    """

    matches: Matches
    sure: Confidence
    used: dict[str, Any]
    courses: dict[str, Course | None]

    @property
    def confidence(self) -> Tensor:
        """``(Q,)`` float32, the probability that the first candidate is right; see `Confidence`."""
        return self.sure.right

    def score_is(self, sequence: str | None = None) -> str:
        """What the scores of candidates are, of one sequence of queries or of all: cosines of
        queries that were judged alone, fused scores if several channels judged them, probabilities
        of queries that were followed."""
        alone = "fused score" if any(self.used["weights"].values()) else "cosine"
        courses = self.courses.values() if sequence is None else [self.courses[sequence]]
        return " or ".join(sorted({"probability" if course else alone for course in courses}))

    def _repr_html_(self) -> str:
        return candidates_table(*self.matches, confidence=self.confidence)


class DriveSearch(Search, Protocol):
    """A search for the queries of one drive, the width of their sweep, and the weights of several
    channels."""

    width: int
    weights: dict[str, float]


@torch.no_grad()
def recognise(
    members: Mapping[str, Member],
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
    excluded: Tensor | None = None,
) -> Recognised:
    """Candidates of each query, and the confidence in the first.

    Args:
        members: raw descriptors of queries and map by each channel; the scores of all are fused,
            see `FusedScores`.
        query_sequences, reference_sequences: the sequence of each; the frames of one stand
            together and in order.
        steps: what is done; without, all steps.
        top: number of candidates of each query.
        excluded: ``(Q, R)`` bool, references that are no candidates.

    Raises:
        ValueError: shapes do not fit.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.recognition.comparison import Member, ReferenceRows
        >>> from ssrvlad_torch.recognition.recognise import recognise
        >>> frames = torch.eye(20)
        >>> member = Member(frames[5:9], ReferenceRows(frames, ["b"] * 20))
        >>> recognise({"x": member}, ["a"] * 4, ["b"] * 20).matches.indices[:, 0].tolist()
        [5, 6, 7, 8]
    """
    steps, top = steps or Steps(), checked_number("top", top, least=1)
    _check_lengths(members, query_sequences, reference_sequences)
    excluded = checked_excluded(excluded, (len(query_sequences), len(reference_sequences)))
    trust = {name: member.trust for name, member in members.items()}
    decisions: dict[str, _Decided] = {}
    for run in runs(query_sequences):
        part = slice(run.start, run.stop)
        standardised = steps.standardise and _are_enough(run, reference_sequences)
        without = None if excluded is None else excluded[part]
        compared = {
            name: each.references.compare(each.queries[part], standardised, steps.sweep, without)
            for name, each in members.items()
        }
        scores, weights = fused_scores(compared, trust)
        decided = _decided(scores, range(len(run)), reference_sequences, steps, top)
        width = max(each.width for each in compared.values())
        decisions[query_sequences[run.start]] = replace(
            decided, standardise=standardised, sweep=width, weights=weights
        )
    return _joined(decisions, len(reference_sequences), steps, top)


def recognise_by_scores(
    scores: Tensor,
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
) -> Recognised:
    """As `recognise`, by scores ``(Q, R)`` float, at most 1, -inf where there can be no match. For
    methods whose encodings are no vectors; following is the only step."""
    steps = replace(steps or Steps(), standardise=False, sweep=False)
    top = checked_number("top", top, least=1)
    decisions = {
        query_sequences[run.start]: _decided(scores, run, reference_sequences, steps, top)
        for run in runs(query_sequences)
    }
    return _joined(decisions, len(reference_sequences), steps, top)


def recognise_by_search(
    search: Callable[[range, bool], DriveSearch],
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
) -> Recognised:
    """As `recognise`, for maps that are too large to score every row. ``search`` returns what finds
    the candidates of the queries of one sequence, by standardised descriptors if its argument is
    true."""
    steps, top = steps or Steps(), checked_number("top", top, least=1)
    decisions: dict[str, _Decided] = {}
    for run in runs(query_sequences):
        standardised = steps.standardise and _are_enough(run, reference_sequences)
        found = search(run, standardised)
        decided = _decided(found, range(len(run)), reference_sequences, steps, top)
        decisions[query_sequences[run.start]] = replace(
            decided, standardise=standardised, sweep=found.width, weights=found.weights
        )
    return _joined(decisions, len(reference_sequences), steps, top)


def judged_alone(query_sequences: Sequence[str], steps: Steps) -> bool:
    """Whether queries are judged alone, not standardised, and their channels weighed by trust,
    whatever the map."""
    fewest = 2 if steps.follow else MIN_FRAMES
    return all(len(run) < fewest for run in runs(query_sequences))


@dataclass(frozen=True)
class _Decided:
    """The candidates of one sequence of queries, and the steps that were taken."""

    matches: Matches
    sure: Confidence
    course: Course | None
    standardise: bool = False
    sweep: int = 0
    weights: dict[str, float] = field(default_factory=dict)


def _decided(
    evidence: Scores | Search, queries: range, sequences: Sequence[str], steps: Steps, top: int
) -> _Decided:
    """Judges each query of a sequence alone, and follows the sequence if that is asked for, it has
    a course, and its answers are not less sure for it."""
    mode = steps.follow if len(queries) > 1 else None
    found = deciding.decide(evidence, queries, sequences, mode, steps.delay, top)
    scores, rows, right, spread, together = (torch.from_numpy(each) for each in found[:5])
    together = together.float().masked_fill(rows[:, 0] < 0, 0)
    sure = Confidence(right.float(), spread.float(), together)
    course = Course(found.way, found.rate, found.streams) if found.followed else None
    return _Decided(Matches(scores.float(), rows), sure, course)


def _told(course: Course | None, steps: Steps) -> str:
    """How a sequence was followed, in words."""
    if course is None:
        return "no, following is no surer" if steps.follow else "no"
    return ", ".join(filter(None, (steps.follow, str(course))))


def _joined(
    decisions: Mapping[str, _Decided], references: int, steps: Steps, top: int
) -> Recognised:
    """The decisions about all sequences of queries, by their names, as one."""
    used: dict[str, Any] = {**asdict(steps), "references": references}
    courses = {name: decision.course for name, decision in decisions.items()}
    used["follow"] = {name: _told(course, steps) for name, course in courses.items()}
    for step in ("standardise", "sweep", "weights"):
        used[step] = {name: getattr(decision, step) for name, decision in decisions.items()}
    none = torch.zeros(0, top)
    matches = [decision.matches for decision in decisions.values()]
    scores = torch.cat([none, *(each.scores for each in matches)])
    indices = torch.cat([none.long(), *(each.indices for each in matches)])
    sures = [Confidence(*[none.sum(1)] * 3), *(each.sure for each in decisions.values())]
    sure = Confidence(*map(torch.cat, zip(*sures, strict=True)))
    return Recognised(Matches(scores, indices), sure, used, courses)


def _are_enough(queries: range, references: Sequence[str]) -> bool:
    return min(len(queries), len(references)) >= MIN_FRAMES


def _check_lengths(
    members: Mapping[str, Member],
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
) -> None:
    """Raises a ValueError unless there is a channel, and a sequence for each frame."""
    if not members:
        raise ValueError("expected a channel by which to recognise, got none")
    for member in members.values():
        for side, names, frames in (
            ("queries", query_sequences, len(member.queries)),
            ("references", reference_sequences, len(member.references)),
        ):
            if len(names) != frames:
                raise ValueError(
                    f"expected a sequence for each of {frames} {side}, got {len(names)}"
                )
