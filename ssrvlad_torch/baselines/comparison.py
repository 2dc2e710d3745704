"""Other methods on the files of references and queries: run, fused and measured."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from ..channels.channel import View
from ..datasets.dataset import Dataset, GroundTruth, LabelsAs
from ..datasets.drives import KINDS, Drives
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import read_image
from ..datasets.label_files import read_label_map
from ..datasets.names import sequence_of
from ..evaluation.measure import TOP, Recognition, measure, needs_similarity
from ..evaluation.metrics import Convention
from ..evaluation.true_matches import Viewpoints, true_matches
from ..recognition.fusion import FusedScores
from ..recognition.recognise import AS_PAPER, Steps, recognise_by_scores
from ..recognition.sequences import runs
from ..taxonomy import label_space
from .protocol import Method
from .run import run
from .stored_descriptors import StoredDescriptors

Row = dict[str, Any]
"""The metrics and costs of a method, or its name and the reason why it could not run."""

Note = Callable[[str], object]
_FUSED = "--fuse"
_AHEAD = 16


class Protocol(NamedTuple):
    """How methods are measured: what is a true match, the convention of the metrics, the steps
    between encodings and a decision, the threads that read ahead, the names of the methods that are
    fused, and what shows the progress of a method with a number of frames."""

    true: GroundTruth
    convention: Convention
    steps: Steps
    workers: int
    fused: Sequence[str]
    progress: Callable[[str, int], AbstractContextManager[Any]]


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
    references, queries = (
        Viewpoints.of(side.frames, drives.whole) for side in (drives.references, drives.queries)
    )
    truth = true_matches(protocol.true, references, queries, note)
    all_pairs = needs_similarity(protocol.convention)
    steps = None if all_pairs or protocol.steps == AS_PAPER else protocol.steps
    no_following = replace(protocol.steps, follow=None, delay=0)
    members: dict[str, Recognition] = {}
    rows: dict[str, list[Row]] = {}
    for name, method in methods.items():
        fused = name in protocol.fused
        taken = no_following if steps and fused else steps
        try:
            results = _recognised(method, drives, protocol, taken, all_pairs or fused)
        except ValueError as error:
            rows[name] = [_not_run(method.name, str(error))]
            continue
        if fused:
            members[name] = results[-1]
            results[1:] = [_by_scores(result, protocol.steps) for result in results[1:]]
        rows[name] = [measure(result, truth, protocol.convention).metrics for result in results]
    if protocol.fused and set(protocol.fused) <= set(members):
        trust = {method.name: getattr(method, "trust", 1.0) for method in methods.values()}
        results = _fused([members[name] for name in protocol.fused], trust, steps or no_following)
        rows[_FUSED] = [measure(result, truth, protocol.convention).metrics for result in results]
    return rows


def _not_run(method: str, reason: str) -> Row:
    return {"method": method, "reason": reason}


def _recognised(
    method: Method, drives: Drives, protocol: Protocol, steps: Steps | None, all_pairs: bool
) -> list[Recognition]:
    """The candidates of every query: of single frames, and, if steps are given, after the steps."""
    if isinstance(method, StoredDescriptors):
        frames = [*drives.references.frames, *drives.queries.frames]
        method.read({frame.frame: frame.image or frame.label for frame in frames})
    labels_as = drives.whole.labels_as
    references, queries = map(Viewpoints.of, (drives.references.frames, drives.queries.frames))
    with protocol.progress(method.name, len(references.frames) + len(queries.frames)) as bar:
        retrieval = run(
            method,
            _views(method, drives.queries, labels_as, protocol.workers),
            _views(method, drives.references, labels_as, protocol.workers),
            top=TOP,
            progress=bar.advance,
            steps=steps,
            all_pairs=all_pairs,
        )
    pairs = retrieval.similarity
    single = Recognition(
        references=references,
        queries=queries,
        matches=retrieval.matches,
        similarity=None if pairs is None else pairs.cpu().numpy(),
        details={
            "method": method.name,
            "temporal": getattr(method, "temporal", None),
            "steps": None,
            **retrieval.costs,
        },
    )
    stepped = retrieval.stepped
    if stepped is None:
        return [single]
    details = {**single.details, "steps": stepped.used}
    return [single, replace(single, matches=stepped.matches, details=details)]


def _fused(
    members: Sequence[Recognition], trust: Mapping[str, float], steps: Steps
) -> list[Recognition]:
    """The fused recognition of single frames, and the followed one if ``steps.follow``. Members are
    recognitions of single frames by each method, with scores of all pairs."""
    details = [member.details for member in members]
    sequences = [*map(sequence_of, members[0].queries.frames)]
    scores = {m.details["method"]: torch.from_numpy(m.similarity) for m in members}
    fused = {
        sequences[run.start]: FusedScores(
            {name: pairs[run.start : run.stop] for name, pairs in scores.items()}, trust
        )
        for run in runs(sequences)
    }
    single = replace(
        members[0],
        similarity=torch.cat([scored.whole() for scored in fused.values()]).numpy(),
        details={
            **details[0],
            "method": " + ".join(scores),
            "temporal": None,
            "weights": {sequence: scored.weights for sequence, scored in fused.items()},
            "bytes_a_reference": sum(detail["bytes_a_reference"] for detail in details),
            **{
                cost: {
                    key: sum(detail[cost][key] for detail in details) for key in details[0][cost]
                }
                for cost in ("encode_ms", "match_ms")
            },
        },
    )
    alone = _by_scores(single, replace(steps, follow=None, delay=0))
    return [alone, _by_scores(single, steps)] if steps.follow else [alone]


def _by_scores(recognition: Recognition, steps: Steps) -> Recognition:
    """The recognition decided anew by its scores of all pairs."""
    scores = torch.from_numpy(recognition.similarity)
    queries = [*map(sequence_of, recognition.queries.frames)]
    references = [*map(sequence_of, recognition.references.frames)]
    recognised = recognise_by_scores(scores, queries, references, steps, TOP)
    used, before = recognised.used, recognition.details["steps"]
    if before:
        used |= {"standardise": before["standardise"], "sweep": before["sweep"]}
    details = {**recognition.details, "steps": used}
    return replace(recognition, matches=recognised.matches, details=details)


def _views(method: Method, side: Dataset, labels_as: LabelsAs, workers: int) -> Iterator[View]:
    """References or queries as the method needs them: with label maps, images, or neither."""
    if not method.needs:
        yield from (View(frame.frame) for frame in side.frames)
        return
    space = label_space(labels_as) if labels_as and "labels" in method.needs else None

    def load(file: FrameFile) -> View:
        if space:
            return View(file.frame, read_label_map(file, space), labels_as)
        return View(file.frame, picture=read_image(file))

    files = side.label_files() if space else side.image_files()
    for file, view in read_ahead(load, files, workers, _AHEAD):
        if isinstance(view, ValueError):
            raise ValueError(f"{file.path}: {view}") from view
        yield view
