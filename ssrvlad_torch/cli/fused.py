"""Several methods as one: their scores of all pairs fused, then followed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..recognition.follow import runs
from ..recognition.fusion import FusedScores
from ..recognition.recognise import Steps, recognise_by_scores
from .measure import TOP, Recognition
from .recognise import unranked


def followed(one: Recognition, steps: Steps) -> Recognition:
    """What a method found of single frames, all pairs ranked, followed by the rest of the steps."""
    return _by_scores(one, _scores(one), steps)


def fused(members: Sequence[Recognition], steps: Steps) -> list[Recognition]:
    """What methods found of single frames, all pairs ranked, as one; then followed, too."""
    first, told = members[0], [member.told for member in members]
    methods, names = [each["method"] for each in told], _sequences(first.queries.frames)
    scores = [_scores(member) for member in members]
    parts = {run: FusedScores([one[run.start : run.stop] for one in scores]) for run in runs(names)}
    together = torch.cat([part.whole() for part in parts.values()])
    costs = {
        cost: {key: sum(each[cost][key] for each in told) for key in ("average", "min", "max")}
        for cost in ("encode_ms", "match_ms")
    }
    weights = {
        names[run.start]: dict(zip(methods, part.weights, strict=True))
        for run, part in parts.items()
    }
    summed = {"bytes_a_reference": sum(each["bytes_a_reference"] for each in told), **costs}
    as_one = {"method": " + ".join(methods), "temporal": None, "weights": weights, **summed}
    one = replace(first, told={**first.told, **as_one})
    if first.similarity is not None:
        one = replace(one, similarity=together.numpy())
    single = _by_scores(one, together, replace(steps, follow=None, delay=0))
    return [single, _by_scores(one, together, steps)] if steps.follow else [single]


def _by_scores(one: Recognition, scores: Tensor, steps: Steps) -> Recognition:
    here, there = (_sequences(part.frames) for part in (one.queries, one.references))
    found = recognise_by_scores(scores, here, there, steps, TOP)
    before = one.told["steps"] or {}
    used = {**found.used, **{key: before[key] for key in ("standardise", "sweep") if key in before}}
    return replace(one, found=found.matches, told={**one.told, "steps": used})


def _scores(one: Recognition) -> Tensor:
    return torch.from_numpy(unranked(one.found, len(one.references.frames)))


def _sequences(frames: Sequence[str]) -> list[str]:
    return [frame.rpartition("/")[0] for frame in frames]
