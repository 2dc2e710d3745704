"""Recognise: from the descriptors of queries and of a map to places, by the steps of this room."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .candidates import Search, follow_candidates, gain
from .confidence import confidence_of_places, confidence_of_scores
from .display import candidates_table
from .filter import Filter
from .follow import Mode, Places, Scores, follow, runs
from .fusion import FusedScores
from .matching import Matches, Rows, Vectors, best_of
from .motion import Motion
from .standardise import LEAST, standardise
from .sweep import COLUMNS, narrowed, score

OWN = "ssr-vlad"
"""What the method itself is called among others."""

_SCORES_IN_MEMORY = 1 << 26
_LEAST_GAIN = 0.01
"""Of frames as a sequence, see `Filter.gain`. Rounding made 2e-7 of single queries and 4e-6 of 2000
equal ones; the drives of docs/fusion.md gain 18 and more."""


@dataclass(frozen=True)
class Steps:
    """What is done between descriptors and a decision.

    Attributes:
        standardise: take each traverse's own mean off, see `standardise`. A traverse of fewer
            than `standardise.LEAST` queries is compared as it is, with the references as they are.
        sweep: use the anchors of queries that have several, see `sweep.narrowed`.
        follow: see `follow.follow`; ``None`` judges every query by itself.
        delay: queries for which an online answer waits.

    Raises:
        ValueError: the delay is negative, or there is one and nothing is followed online; or there
            is no such way to follow.
    """

    standardise: bool = True
    sweep: bool = True
    follow: Mode | None = "offline"
    delay: int = 0

    def __post_init__(self) -> None:
        if self.follow not in (None, "online", "offline"):
            raise ValueError(f"follow: expected online, offline or None, got {self.follow!r}")
        if self.delay < 0 or (self.delay and self.follow != "online"):
            raise ValueError(
                f"delay: expected 0, or more with follow online, got {self.delay} with "
                f"{self.follow or 'no'}"
            )


AS_PAPER = Steps(standardise=False, sweep=False, follow=None)


class Recognised(NamedTuple):
    """What was found.

    Attributes:
        matches: ``(Q, top)``: scores are cosines for single frames, and probabilities where the
            sequence was followed; that of the first candidate is of its neighbourhood.
            An empty query has no candidate.
        confidence: ``(Q,)`` float32, the probability that the first candidate is right, see
            `confidence`; 0 without one, and where fewer than `standardise.LEAST` references are
            too few to tell.
        used: what was done, to be told: the steps, and by sequence whether it was standardised,
            the width of the sweep, how it was followed, and what each of several methods weighs.
    """

    matches: Matches
    confidence: Tensor
    used: dict[str, Any]

    def _repr_html_(self) -> str:
        return candidates_table(*self.matches, confidence=self.confidence)


@torch.no_grad()
def recognise(
    queries: Vectors,
    references: Vectors,
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
    barred: Tensor | None = None,
    beside: Mapping[str, tuple[Vectors, Vectors]] | None = None,
) -> Recognised:
    """Candidates of every query, and how sure the first is.

    Args:
        queries: ``(Q, D)`` raw descriptors, or ``(Q, S, D)`` of a sweep over `sweep.COLUMNS`.
        references: ``(R, D)`` raw descriptors.
        query_sequences, reference_sequences: the sequence of each; the frames of one stand
            together and in order.
        steps: what is done; without, all.
        top: candidates of each query.
        barred: ``(Q, R)`` bool, references that are no candidates.
        beside: of further methods queries ``(Q, D')`` and references ``(R, D')`` by name; the
            scores of all are fused, see `FusedScores`.

    Raises:
        ValueError: shapes do not fit.

    Example:
        >>> frames = torch.eye(20)
        >>> recognise(frames[5:9], frames, ["a"] * 4, ["b"] * 20).matches.indices[:, 0].tolist()
        [5, 6, 7, 8]
    """
    steps = steps or Steps()
    methods = {
        name: (torch.as_tensor(wanted), torch.as_tensor(known).float())
        for name, (wanted, known) in {OWN: (queries, references), **(beside or {})}.items()
    }
    for wanted, _ in methods.values():
        if len(query_sequences) != len(wanted):
            got = len(query_sequences)
            raise ValueError(f"expected a sequence for each of {len(wanted)} queries, got {got}")

    @cache
    def measured(name: str, own: bool) -> Rows:
        known = methods[name][1]
        return Rows.of(standardise(known, reference_sequences) if own else known)

    def judge(run: range) -> _Outcome:
        rows = slice(run.start, run.stop)
        own = steps.standardise and len(run) >= LEAST
        members, widths = list[Scores](), list[int]()
        for name, (wanted, _) in methods.items():
            known = measured(name, own)
            part, width = _prepared(wanted[rows], known, replace(steps, standardise=own))
            members.append(_Scores(part, known, None if barred is None else barred[rows]))
            widths.append(width)
        scores, weights = _together(members, list(methods))
        found, followed = _judged(scores, reference_sequences, steps, top)
        return _Outcome(*found, own, max(widths), followed, weights)

    return _of_each(query_sequences, len(reference_sequences), steps, top, judge)


def recognise_by_scores(
    scores: Tensor,
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
) -> Recognised:
    """As `recognise`, by scores ``(Q, R)`` float, at most 1, -inf where there can be no match, of
    methods whose encodings are no vectors: they can only be followed."""
    steps = replace(steps or Steps(), standardise=False, sweep=False)

    def judge(run: range) -> _Outcome:
        part = scores[run.start : run.stop]
        found, followed = _judged(part, reference_sequences, steps, top)
        return _Outcome(*found, False, 0, followed, {})

    return _of_each(query_sequences, len(reference_sequences), steps, top, judge)


def recognise_by_search(
    search: Callable[[bool], Search],
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
) -> Recognised:
    """As `recognise`, over the candidates of a search, for maps that are too large to score every
    row. ``search`` gives what finds candidates, standardised or not; there is no sweep."""
    steps = replace(steps or Steps(), sweep=False)

    def judge(run: range) -> _Outcome:
        own, mode = steps.standardise and len(run) >= LEAST, steps.follow
        found = search(own)
        if not mode or gain(found, reference_sequences, Motion(unmapped=0.0), run) <= _LEAST_GAIN:
            alone = []
            for query in run:
                rows = found.candidates(query).sort().values
                scores = found.scores(query, rows)
                sure = confidence_of_scores(scores, rows, found.spread(query))
                alone.append((best_of(scores, top, rows), sure))
            return _Outcome(*_single(alone), own, 0, "no", {})
        places = follow_candidates(found, reference_sequences, run, mode, steps.delay, top)
        empty = torch.tensor([not len(found.candidates(query)) for query in run])
        return _Outcome(*_placed(places, empty, mode), own, 0, mode, {})

    return _of_each(query_sequences, len(reference_sequences), steps, top, judge)


class _Outcome(NamedTuple):
    """The outcome of one sequence of queries, and the steps that it took."""

    matches: Matches
    confidence: Tensor
    standardise: bool
    sweep: int
    follow: str
    weights: dict[str, float]


def _of_each(
    sequences: Sequence[str],
    references: int,
    steps: Steps,
    top: int,
    judge: Callable[[range], _Outcome],
) -> Recognised:
    """Judges the queries sequence by sequence, and joins the outcomes."""
    judged = {run: judge(run) for run in runs(sequences)}
    used: dict[str, Any] = {**asdict(steps), "references": references}
    for step in ("standardise", "sweep", "follow", "weights"):
        used[step] = {sequences[run.start]: getattr(one, step) for run, one in judged.items()}
    none = torch.zeros(0, top)
    scores, indices, sure = (
        torch.cat([empty, *parts])
        for empty, parts in (
            (none, [one.matches.scores for one in judged.values()]),
            (none.long(), [one.matches.indices for one in judged.values()]),
            (none.sum(1), [one.confidence for one in judged.values()]),
        )
    )
    return Recognised(Matches(scores, indices), sure * (references >= LEAST), used)


def _prepared(queries: Tensor, references: Rows, steps: Steps) -> tuple[Tensor, int]:
    """The queries of one sequence, standardised, and the width of their sweep."""
    if queries.ndim == 3 and not steps.sweep:
        queries = queries[:, queries.shape[1] // 2]
    if queries.ndim == 3:
        return narrowed(queries, references, COLUMNS, steps.standardise)
    return (standardise(queries) if steps.standardise else queries), 0


class _Scores(Scores):
    """Scores of one sequence, computed at once if they are few and by blocks of queries if not."""

    def __init__(self, queries: Tensor, references: Rows, barred: Tensor | None) -> None:
        self._queries, self._references, self._barred = queries, references, barred
        anchors = queries.shape[1] if queries.ndim == 3 else 1
        few = len(queries) * len(references) <= _SCORES_IN_MEMORY
        room = _SCORES_IN_MEMORY // (4 * anchors * max(1, len(references)))
        self._block = len(queries) if few else max(1, room)
        self._first, self._known = 0, torch.empty(0)

    def __len__(self) -> int:
        return len(self._queries)

    def __getitem__(self, query: int, /) -> Tensor:
        if not self._first <= query < self._first + len(self._known):
            self._first = query - query % self._block
            part = slice(self._first, self._first + self._block)
            self._known = score(self._queries[part], self._references)
        row = self._known[query - self._first]
        return row if self._barred is None else row.masked_fill(self._barred[query], -torch.inf)


def _together(
    members: Sequence[Scores], names: Sequence[str]
) -> tuple[Scores | Tensor, dict[str, float]]:
    """The scores of all methods as one, in memory if few, and what each weighs if several."""
    if len(members) == 1:
        return members[0], {}
    fused = FusedScores(members)
    few = len(fused) * len(fused[0]) <= _SCORES_IN_MEMORY
    weights = dict(zip(names, fused.weights, strict=True))
    return fused.whole() if few else fused, weights


def _judged(
    scores: Tensor | Scores, sequences: Sequence[str], steps: Steps, top: int
) -> tuple[tuple[Matches, Tensor], str]:
    """Candidates and confidences of one sequence, and how it was followed."""
    mode = steps.follow
    if mode is not None and _is_sequence(scores, sequences):
        places = follow(scores, sequences, mode=mode, delay=steps.delay, top=top)
        empty = torch.tensor([not scores[query].isfinite().any() for query in range(len(scores))])
        return _placed(places, empty, mode), mode
    alone = (scores[query] for query in range(len(scores)))
    return _single([(best_of(one, top), confidence_of_scores(one)) for one in alone]), "no"


def _placed(places: Places, empty: Tensor, mode: Mode) -> tuple[Matches, Tensor]:
    """Candidates and confidences of queries that were followed; an empty query has none."""
    ranked = torch.cat((places.near[:, None], places.scores[:, 1:]), 1)
    found = Matches(
        ranked.masked_fill(empty[:, None] | (places.indices < 0), -torch.inf),
        places.indices.masked_fill(empty[:, None], -1),
    )
    return found, confidence_of_places(places.near, mode).masked_fill(empty, 0)


def _single(found: Sequence[tuple[Matches, Tensor]]) -> tuple[Matches, Tensor]:
    """Candidates and confidences of queries that were judged one by one."""
    matches, sure = zip(*found, strict=True)
    return Matches(*map(torch.stack, zip(*matches, strict=True))), torch.stack(sure)


def _is_sequence(scores: Tensor | Scores, sequences: Sequence[str]) -> bool:
    """Whether the frames, all of them in the map, are likelier as a sequence than each alone."""
    track = Filter(sequences, Motion(unmapped=0.0))
    for query in range(len(scores)):
        track.step(scores[query])
    return track.gain > _LEAST_GAIN
