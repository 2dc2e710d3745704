"""Recognise: from descriptors of queries and of a map to places, with a confidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .blocks import Computed, fused_scores, in_blocks, of_vectors
from .candidates import Search, follow_candidates, gain_of_candidates
from .confidence import ALONE, ALONE_BY_FEATURES, Confidence, Prior, answered, answers_together
from .courses import Gain, course
from .decoys import Lead, Mirror, decoy_scores, lead_over_decoys
from .display import candidates_table
from .follow import Mode, Places, Scores, follow, gain, runs
from .matching import Matches, Rows, Vectors, best_of, checked_excluded, checked_number, real_tensor
from .motion import Motion
from .signs import REACH, SignQueries, SignRows, are_signs
from .signs import mirrored as mirrored_signs
from .standardise import MIN_FRAMES, standardise
from .sweep import COLUMNS, narrowed

SSR_VLAD = "ssr-vlad"
"""The name of the descriptor among fused methods."""

NO_SEQUENCE = "no, no sequence"
"""How queries are followed of which the data do not show that they run the map."""


@dataclass(frozen=True)
class Steps:
    """What is done between descriptors and a decision.

    Attributes:
        standardise: subtract the mean of each traverse, see `standardise`. A traverse of fewer
            than `standardise.MIN_FRAMES` queries, and the references for it, stay raw; so does all
            for a map of fewer references.
        sweep: use all anchors of queries that have several, see `sweep.narrowed`.
        follow: see `follow.follow`; ``None`` judges each query alone. So are sequences of which
            the data do not show that they run the map, see `courses.course`, and those whose
            answers the decoy beats without exception.
        delay: number of later queries that an online answer waits for.

    Raises:
        ValueError: ``follow`` is none of these, the delay is no whole number from 0, or there
            is a delay and ``follow`` is not online.
    """

    standardise: bool = True
    sweep: bool = True
    follow: Mode | None = "offline"
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
            that is followed are probabilities: for the first candidate that of its neighbourhood
            (`Places.near`), for the others that of the row alone. An empty query has no candidate.
        sure: how sure the first candidates are; all 0 with fewer than `standardise.MIN_FRAMES`
            references.
        used: the steps as a report: `Steps` and the number of references, and by sequence whether
            it was standardised, the width of its sweep, how it was followed (the mode and the
            `Course`, ``no``, or `NO_SEQUENCE`), and the weights of fused methods.
    """

    matches: Matches
    sure: Confidence
    used: dict[str, Any]

    @property
    def confidence(self) -> Tensor:
        """``(Q,)`` float32, the probability that the first candidate is right; see `Confidence`."""
        return self.sure.right

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
    excluded: Tensor | None = None,
    extra: Mapping[str, tuple[Vectors, Vectors]] | None = None,
    mirrors: Mapping[str, Mirror] | None = None,
) -> Recognised:
    """Candidates of each query, and the confidence in the first.

    Args:
        queries: ``(Q, D)`` raw descriptors, or ``(Q, S, D)`` of a sweep over `sweep.COLUMNS`.
        references: ``(R, D)`` raw descriptors.
        query_sequences, reference_sequences: the sequence of each; the frames of one stand
            together and in order.
        steps: what is done; without, all steps.
        top: number of candidates of each query.
        excluded: ``(Q, R)`` bool, references that are no candidates.
        extra: queries ``(Q, D')`` and references ``(R, D')`` of extra methods by their names,
            or signs, see `signs`; the scores of all methods are fused, see `FusedScores`.
        mirrors: of all methods but signs by their names, `SSR_VLAD` for the descriptors: the decoys
            by which queries that are judged alone are calibrated. Without, by their lead over other
            places.

    Raises:
        ValueError: shapes do not fit, or a method has no mirror.

    Examples:
        >>> frames = torch.eye(20)
        >>> recognise(frames[5:9], frames, ["a"] * 4, ["b"] * 20).matches.indices[:, 0].tolist()
        [5, 6, 7, 8]
    """
    steps = steps or Steps()
    pairs = {SSR_VLAD: (queries, references), **(extra or {})}
    queries_of = {name: real_tensor(pair[0], f"{name} of queries") for name, pair in pairs.items()}
    sides = {"queries": query_sequences, "references": reference_sequences}
    for pair in pairs.values():
        for (what, names), vectors in zip(sides.items(), pair, strict=True):
            if len(names) != len(vectors):
                size = f"{len(vectors)} {what}"
                raise ValueError(f"expected a sequence for each of {size}, got {len(names)}")
    excluded = checked_excluded(excluded, (len(query_sequences), len(reference_sequences)))
    mirrored = {name for name, vectors in queries_of.items() if not are_signs(vectors)}
    if mirrors is not None and not mirrored <= set(mirrors):
        named = ", ".join(mirrors) or "none"
        raise ValueError(f"expected mirrors of {', '.join(sorted(mirrored))}, got {named}")

    @cache
    def rows_of(name: str, standardised: bool) -> Rows | SignRows:
        vectors = real_tensor(pairs[name][1], f"{name} of references")
        if are_signs(vectors):
            return SignRows(vectors, reference_sequences if standardised else None)
        vectors = vectors.float()
        return Rows.of(standardise(vectors, reference_sequences) if standardised else vectors)

    def decide(run: range) -> _Decision:
        part = slice(run.start, run.stop)
        enough = min(len(run), len(reference_sequences)) >= MIN_FRAMES
        standardised = steps.standardise and enough
        without = None if excluded is None else excluded[part]
        width, members, decoys = 0, dict[str, Scores](), dict[str, Scores]()
        for name, vectors in queries_of.items():
            rows = rows_of(name, standardised)
            if isinstance(rows, SignRows):
                reach = REACH if steps.sweep else 0
                signs = SignQueries(vectors[part], rows, standardised, reach)
                turned = SignQueries(mirrored_signs(vectors[part]), rows, standardised, reach)
                size = len(run), len(rows), signs.moves
                members[name] = in_blocks(signs.scores, *size, without)
                decoys[name] = in_blocks(turned.scores, *size, without)
                continue
            compared, reach = vectors[part], 0
            if compared.ndim == 3 and steps.sweep:
                compared, reach = narrowed(compared, rows, COLUMNS, standardised)
            else:
                compared = compared[:, compared.shape[1] // 2] if compared.ndim == 3 else compared
                compared = standardise(compared) if standardised else compared
            members[name] = of_vectors(compared, rows, without)
            if mirrors is not None:
                mean = None if standardised else rows.mean()
                against = partial(decoy_scores, mirror=mirrors[name], mean=mean)
                decoys[name] = of_vectors(compared, rows, without, against)
            width = max(width, reach)
        scores, of_decoys, weights = fused_scores(members, decoys)
        prior = ALONE if mirrored == set(queries_of) else ALONE_BY_FEATURES
        decision = _by_scores(scores, reference_sequences, steps, top, of_decoys, prior)
        return replace(decision, standardise=standardised, sweep=width, weights=weights)

    return _by_sequence(decide, query_sequences, len(reference_sequences), steps, top)


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

    def decide(run: range) -> _Decision:
        return _by_scores(scores[run.start : run.stop], reference_sequences, steps, top)

    return _by_sequence(decide, query_sequences, len(reference_sequences), steps, top)


def recognise_by_search(
    search: Callable[[bool], Search],
    query_sequences: Sequence[str],
    reference_sequences: Sequence[str],
    steps: Steps | None = None,
    top: int = 5,
    decoys: Callable[[bool], Search] | None = None,
) -> Recognised:
    """As `recognise`, for maps that are too large to score every row; without a sweep. ``search``
    returns what finds candidates, by standardised descriptors if its argument is true; ``decoys``
    the same for mirrored queries."""
    steps = replace(steps or Steps(), sweep=False)

    def decide(run: range) -> _Decision:
        enough = min(len(run), len(reference_sequences)) >= MIN_FRAMES
        standardised = steps.standardise and enough
        found, sequences = search(standardised), reference_sequences
        mode, delay = steps.follow or "offline", steps.delay

        def judged() -> list[tuple[Matches, Lead]]:
            against = decoys(standardised) if decoys else None
            return [_best_candidates(found, against, query, top) for query in run]

        decision = _decided(
            run,
            partial(gain_of_candidates, found, sequences),
            lambda part, motion, way: follow_candidates(
                found, sequences, part, mode, delay, top, motion, way
            ),
            lambda query: len(found.candidates(query)) == 0,
            judged,
            steps.follow,
        )
        return replace(decision, standardise=standardised)

    return _by_sequence(decide, query_sequences, len(reference_sequences), steps, top)


@dataclass(frozen=True)
class _Decision:
    """The candidates of one sequence of queries, and the steps that were taken."""

    matches: Matches
    sure: Confidence
    standardise: bool = False
    sweep: int = 0
    follow: str = "no"
    weights: dict[str, float] = field(default_factory=dict)


def _by_sequence(
    decide: Callable[[range], _Decision],
    sequences: Sequence[str],
    references: int,
    steps: Steps,
    top: int,
) -> Recognised:
    """Decides about each sequence of queries, and joins the decisions."""
    top = checked_number("top", top, least=1)
    decisions = {run: decide(run) for run in runs(sequences)}
    used: dict[str, Any] = {**asdict(steps), "references": references}
    for step in ("standardise", "sweep", "follow", "weights"):
        used[step] = {sequences[run.start]: getattr(d, step) for run, d in decisions.items()}
    none = torch.zeros(0, top)
    matches = [decision.matches for decision in decisions.values()]
    scores = torch.cat([none, *(each.scores for each in matches)])
    indices = torch.cat([none.long(), *(each.indices for each in matches)])
    each_sure = [Confidence(*[none.sum(1)] * 3), *(each.sure for each in decisions.values())]
    sure = Confidence(*map(torch.cat, zip(*each_sure, strict=True)))
    if references < MIN_FRAMES:
        sure = sure._replace(right=torch.zeros_like(sure.right))
    return Recognised(Matches(scores, indices), sure, used)


def _by_scores(
    scores: Tensor | Scores,
    sequences: Sequence[str],
    steps: Steps,
    top: int,
    decoys: Scores | None = None,
    prior: Prior = ALONE,
) -> _Decision:
    """Decides about one sequence of queries by the scores of all rows."""
    queries, mode = range(len(scores)), steps.follow or "offline"

    def followed(part: range, motion: Motion, way: int) -> Places:
        some = Computed(lambda query: scores[part[query]], len(part))
        return follow(some, sequences, None, mode, steps.delay, top, motion, way)

    def judged() -> list[tuple[Matches, Lead]]:
        found = []
        for query in queries:
            own, against = scores[query], None if decoys is None else decoys[query]
            found.append((best_of(own, top), lead_over_decoys(own, against)))
        return found

    return _decided(
        queries,
        partial(gain, scores, sequences),
        followed,
        lambda query: not scores[query].isfinite().any(),
        judged,
        steps.follow,
        prior,
    )


def _decided(
    queries: range,
    gain: Gain,
    follow: Callable[[range, Motion, int], Places],
    is_empty: Callable[[int], bool],
    judge: Callable[[], Sequence[tuple[Matches, Lead]]],
    mode: Mode | None,
    prior: Prior = ALONE,
) -> _Decision:
    """Follows one sequence of queries, each stream of its course by itself. Judges each query alone
    without a mode, without a course, and if the decoy beats every answer, as in a map of sequences
    too short to be run. An empty query has no candidate. For scores, see `Recognised`."""
    taken = course(gain, queries) if mode else None
    if mode and taken:
        parts, motion = taken.parts(queries), Motion().at(taken.rate)
        streams = [follow(part, motion, taken.way) for part in parts]
        order = torch.tensor([query for part in parts for query in part]).argsort()
        places = Places(*(torch.cat(values)[order] for values in zip(*streams, strict=True)))
        empty = torch.tensor([is_empty(query) for query in queries])
        scores = torch.cat((places.near[:, None], places.scores[:, 1:]), 1)
        scores = scores.masked_fill(empty[:, None] | (places.indices < 0), -torch.inf)
        matches = Matches(scores, places.indices.masked_fill(empty[:, None], -1))
        near = places.near.masked_fill(empty, torch.nan)
        sure = Confidence.of_places(near, places.backward, mode)
        if answered(sure).any():
            how = ", ".join(part for part in (mode, str(taken)) if part)
            return _Decision(matches, sure, follow=how)
    judged = judge()
    matches = Matches(*map(torch.stack, zip(*(each for each, _ in judged), strict=True)))
    leads = torch.tensor([lead.value for _, lead in judged])
    rows = torch.tensor([lead.decoy for _, lead in judged])
    decoys = bool((rows >= 0).any())
    sure = Confidence.of_leads(leads, prior, answers_together(rows) if decoys else 1.0, decoys)
    return _Decision(matches, sure, follow=NO_SEQUENCE if mode else "no")


def _best_candidates(
    search: Search, decoys: Search | None, query: int, top: int
) -> tuple[Matches, Lead]:
    """The candidates of a query alone, and its lead over the decoys."""
    rows = search.candidates(query).sort().values
    scores = search.scores(query, rows)
    mean, deviation = search.spread(query)
    found = best_of(scores, top, rows)
    if decoys is None:
        return found, lead_over_decoys(scores, rows=rows, deviation=deviation)
    against = decoys.candidates(query).sort().values
    mean_of_decoys, of_decoys = decoys.spread(query)
    apart = (mean - mean_of_decoys) / 2
    both = math.sqrt((deviation**2 + of_decoys**2) / 2 + apart**2)
    return found, lead_over_decoys(scores, decoys.scores(query, against), rows, against, both)
