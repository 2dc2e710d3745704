"""Fused methods: the scores of several methods for all pairs, added up and followed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..recognition.follow import runs
from ..recognition.fusion import FusedScores
from ..recognition.recognise import Steps, recognise_by_scores
from .measure import TOP, Recognition
from .methods import similarity_of


def followed(recognition: Recognition, steps: Steps) -> Recognition:
    """A method's recognition of single frames, with scores of all pairs, after following."""
    return _by_scores(recognition, _scores(recognition), steps)


def fused(members: Sequence[Recognition], steps: Steps) -> list[Recognition]:
    """The fused recognition of single frames, and the followed one if ``steps.follow``.

    Args:
        members: recognitions of single frames by each method, with scores of all pairs.
        steps: of which only following applies.
    """
    first, details = members[0], [member.details for member in members]
    methods, names = [each["method"] for each in details], _sequences(first.queries.frames)
    scores = [_scores(member) for member in members]
    parts = {
        run: FusedScores(
            {name: m[run.start : run.stop] for name, m in zip(methods, scores, strict=True)}
        )
        for run in runs(names)
    }
    sums = torch.cat([part.whole() for part in parts.values()])
    costs = {
        cost: {key: sum(each[cost][key] for each in details) for key in ("average", "min", "max")}
        for cost in ("encode_ms", "match_ms")
    }
    weights = {names[run.start]: part.weights for run, part in parts.items()}
    fusion = {
        **{"method": " + ".join(methods), "temporal": None, "weights": weights},
        **{"bytes_a_reference": sum(each["bytes_a_reference"] for each in details), **costs},
    }
    single = replace(first, details={**first.details, **fusion})
    if first.similarity is not None:
        single = replace(single, similarity=sums.numpy())
    alone = _by_scores(single, sums, replace(steps, follow=None, delay=0))
    return [alone, _by_scores(single, sums, steps)] if steps.follow else [alone]


def _by_scores(recognition: Recognition, scores: Tensor, steps: Steps) -> Recognition:
    queries, references = recognition.queries.frames, recognition.references.frames
    found = recognise_by_scores(scores, _sequences(queries), _sequences(references), steps, TOP)
    before = recognition.details["steps"] or {}
    used = {**found.used, **{key: before[key] for key in ("standardise", "sweep") if key in before}}
    details = {**recognition.details, "steps": used}
    return replace(recognition, matches=found.matches, details=details)


def _scores(recognition: Recognition) -> Tensor:
    return torch.from_numpy(similarity_of(recognition.matches, len(recognition.references.frames)))


def _sequences(frames: Sequence[str]) -> list[str]:
    return [frame.rpartition("/")[0] for frame in frames]
