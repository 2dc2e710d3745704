"""Several methods as one: their scores of all pairs fused, then followed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..recognition.follow import runs
from ..recognition.fusion import FusedScores
from ..recognition.recognise import Steps, recognise_by_scores
from .measure import TOP, Recognition
from .recognise import unranked

COSTS = ("encode_ms", "match_ms")


def followed(one: Recognition, steps: Steps) -> Recognition:
    """What a method found of single frames, all pairs ranked, followed by the rest of the steps."""
    return _by_scores(one, _scores(one), steps)


def fused(members: Sequence[Recognition], steps: Steps) -> list[Recognition]:
    """What methods found of single frames, all pairs ranked, as one; then followed, too."""
    first = members[0]
    scores = [_scores(member) for member in members]
    names = _sequences(first.queries.frames)
    parts = [FusedScores([one[run.start : run.stop] for one in scores]) for run in runs(names)]
    weights = {
        names[run.start]: dict(zip(_names(members), part.weights, strict=True))
        for run, part in zip(runs(names), parts, strict=True)
    }
    together = torch.cat([part.whole() for part in parts])
    told = {
        **first.told,
        "method": " + ".join(_names(members)),
        "temporal": None,
        "weights": weights,
        "bytes_a_reference": sum(member.told["bytes_a_reference"] for member in members),
        **{cost: _summed([member.told[cost] for member in members]) for cost in COSTS},
    }
    one = replace(first, told=told)
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


def _names(members: Sequence[Recognition]) -> list[str]:
    return [member.told["method"] for member in members]


def _summed(costs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    return {key: sum(cost[key] for cost in costs) for key in ("average", "min", "max")}
