"""Other methods on the files of references and queries: run, fused and measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..datasets.drives import KINDS, Drives
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import read_image
from ..datasets.label_files import read_label_map
from ..evaluation.measure import TOP, Recognition, measure, needs_similarity
from ..evaluation.metrics import Convention
from ..evaluation.true_matches import TrueMatches, Viewpoints
from ..recognition.follow import runs
from ..recognition.fusion import FusedScores
from ..recognition.recognise import AS_PAPER, Steps, recognise_by_scores
from ..taxonomy import LabelSpace, label_space
from .protocol import Frame, Method
from .run import run

Row = dict[str, Any]
"""The metrics and costs of a method, or its name and the reason why it could not run."""

Note = Callable[[str], object]


class Protocol(NamedTuple):
    """How methods are measured: what is a true match, the convention of the metrics, the steps
    between encodings and a decision, the threads that read ahead, the names of the methods that are
    fused, and what shows the progress of a method with a number of frames."""

    true: TrueMatches
    convention: Convention
    steps: Steps
    workers: int
    fused: Sequence[str]
    progress: Callable[[str, int], AbstractContextManager[Callable[[int], None]]]


_FUSED = "--fuse"
_AHEAD = 16


def compare(
    methods: Mapping[str, Method | str], drives: Drives, protocol: Protocol, note: Note
) -> list[Row]:
    """The rows of all methods in their order, then the rows of the fused methods. A method that
    cannot be made is given by the reason; ``note`` gets what is left out."""
    lacking = {kind: reason for kind in KINDS if (reason := drives.lacks(kind))}
    rows: dict[str, list[Row]] = {}
    able: dict[str, Method] = {}
    for name, method in methods.items():
        if isinstance(method, str):
            rows[name] = [_not_run(name, method)]
        elif reasons := [lacking[need] for need in sorted(method.needs) if need in lacking]:
            rows[name] = [_not_run(method.name, reasons[0])]
        else:
            able[name] = method
    if able:
        needs = {need for method in able.values() for need in method.needs}
        drives = drives.complete([kind for kind in KINDS if kind in needs], note)
        rows |= _measured(able, drives, protocol, note)
    if protocol.fused and _FUSED not in rows:
        missing = next(name for name in protocol.fused if "reason" in rows[name][0])
        rows[_FUSED] = [_not_run(" + ".join(protocol.fused), f"{missing} does not run")]
    order = [*methods, _FUSED] if protocol.fused else methods
    return [row for name in order for row in rows[name]]


def _measured(
    methods: Mapping[str, Method], drives: Drives, protocol: Protocol, note: Note
) -> dict[str, list[Row]]:
    """The rows of each method: of single frames, and with the steps."""
    true, convention, steps, workers, to_fuse, progress = protocol
    parts, whole, rows = (drives.references, drives.queries), drives.whole, dict[str, list[Row]]()
    references, queries = (Viewpoints.of(part.frames, whole) for part in parts)
    truth = true.among(references, queries, note)
    all_steps = None if needs_similarity(convention) or steps == AS_PAPER else steps
    no_following = replace(steps, follow=None, delay=0)
    members: dict[str, Recognition] = {}

    def measured(found: Sequence[Recognition]) -> list[Row]:
        return [measure(each, truth, convention) for each in found]

    for name, method in methods.items():
        labelled = "labels" in method.needs
        files, others = (part.label_files() if labelled else part.image_files() for part in parts)
        labels_as = whole.labels_as if labelled else None
        all_pairs = needs_similarity(convention) or name in to_fuse
        method_steps = no_following if all_steps and name in to_fuse else all_steps
        try:
            with progress(method.name, len(files) + len(others)) as advance:
                found = run_method(
                    method, files, others, labels_as, workers, all_pairs, method_steps, advance
                )
        except ValueError as error:
            rows[name] = [_not_run(method.name, str(error))]
            continue
        if name in to_fuse:
            members[name] = found[-1]
            found = [found[0], *(_by_scores(each, _scores(each), steps) for each in found[1:])]
        rows[name] = measured(found)
    if to_fuse and set(to_fuse) <= set(members):
        chosen = [members[name] for name in to_fuse]
        rows[_FUSED] = measured(fused_methods(chosen, all_steps or no_following))
    return rows


def _not_run(method: str, reason: str) -> Row:
    return {"method": method, "reason": reason}


def run_method(
    method: Method,
    references: Sequence[FrameFile],
    queries: Sequence[FrameFile],
    labels_as: str | LabelSpace | None,
    workers: int,
    all_pairs: bool,
    steps: Steps | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> list[Recognition]:
    """The candidates of every query: of single frames, and, if steps are given, after the steps.
    Files are label maps of a label space, or images without one; ``progress`` is called with 1 for
    every frame."""
    retrieval = run(
        method,
        _frames(queries, labels_as, workers),
        _frames(references, labels_as, workers),
        top=TOP,
        progress=progress,
        steps=steps,
        all_pairs=all_pairs,
    )
    pairs = retrieval.similarity
    single = Recognition(
        references=Viewpoints.of(references),
        queries=Viewpoints.of(queries),
        matches=retrieval.matches,
        similarity=None if pairs is None else pairs.cpu().numpy(),
        details={
            "method": method.name,
            "temporal": getattr(method, "temporal", None),
            "steps": None,
            "encode_ms": retrieval.encode,
            "match_ms": retrieval.match,
            "bytes_a_reference": retrieval.bytes_a_reference,
        },
    )
    stepped = retrieval.stepped
    if stepped is None:
        return [single]
    details = {**single.details, "steps": stepped.used}
    return [single, replace(single, matches=stepped.matches, details=details)]


def fused_methods(members: Sequence[Recognition], steps: Steps) -> list[Recognition]:
    """The fused recognition of single frames, and the followed one if ``steps.follow``. Members are
    recognitions of single frames by each method, with scores of all pairs."""
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
    """The scores of all pairs of a recognition of single frames."""
    return torch.from_numpy(recognition.similarity)


def _sequences(frames: Sequence[str]) -> list[str]:
    return [frame.rpartition("/")[0] for frame in frames]


def _frames(
    files: Sequence[FrameFile], labels_as: str | LabelSpace | None, workers: int
) -> Iterator[Frame]:
    """Frames with their label maps, or, without a label space, with their images."""
    space = label_space(labels_as) if labels_as else None
    name = labels_as if isinstance(labels_as, str) else space.name if space else None

    def load(file: FrameFile) -> Frame:
        if space:
            return Frame(file.frame, read_label_map(file, space), name)
        return Frame(file.frame, image=read_image(file))

    for file, frame in read_ahead(load, files, workers, _AHEAD):
        if isinstance(frame, ValueError):
            raise ValueError(f"{file.path}: {frame}") from frame
        yield frame
