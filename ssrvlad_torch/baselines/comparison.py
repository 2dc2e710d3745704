"""Other methods on the files of references and queries: run, fused and measured."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, NamedTuple

from ..channels.channel import View
from ..datasets.dataset import Dataset, DatasetFrame, GroundTruth
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import read_image
from ..datasets.label_files import read_label_map
from ..datasets.names import sequence_of
from ..datasets.sides import ROLES
from ..evaluation.measure import TOP, Recognition, measure
from ..evaluation.metrics import Convention
from ..evaluation.true_matches import Viewpoints, true_matches
from ..recognition.matching import Matches
from ..recognition.recognise import AS_PAPER, Recognised, Steps, recognise, references_of
from ..taxonomy import label_space
from .protocol import Method
from .run import Retrieval, run
from .stored_descriptors import StoredDescriptors

Row = dict[str, Any]
"""The metrics and costs of a method, or its name and the reason why it could not run."""

Note = Callable[[str], object]
KINDS: dict[str, tuple[Callable[[DatasetFrame], object], str]] = {
    "images": (lambda frame: frame.image, "an image"),
    "labels": (lambda frame: frame.label, "a label map"),
}
"""The kinds of files that a method may need of a frame, each also in words."""

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
    methods: Mapping[str, Method | str], sides: Dataset, protocol: Protocol, note: Note
) -> list[Row]:
    """The rows of all methods in their order, then the rows of the fused methods. A method that
    cannot be made is given by the reason; ``sides`` are references and queries, see `open_sides`;
    ``note`` gets what is left out."""
    used = sides
    if protocol.true.metres is not None:
        used = _having(sides, lambda frame: frame.has_pose, "a pose")
    lacking = {kind: reason for kind in KINDS if (reason := _lacks(used, kind))}
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
        rows |= _measured(able, sides, _complete(used, needs, note), protocol, note)
    if protocol.fused and _FUSED not in rows:
        missing = next(name for name in protocol.fused if "reason" in rows[name][0])
        rows[_FUSED] = [_not_run(" + ".join(protocol.fused), f"{missing} does not run")]
    order = [*methods, _FUSED] if protocol.fused else methods
    return [row for name in order for row in rows[name]]


def _having(sides: Dataset, has: Callable[[DatasetFrame], object], what: str) -> Dataset:
    """The frames that ``has`` accepts; a ValueError if no reference or no query is left."""
    frames = tuple(filter(has, sides.frames))
    for role in ROLES:
        if not any(frame.role == role for frame in frames):
            raise ValueError(f"no {role} has {what}")
    return replace(sides, frames=frames)


def _lacks(sides: Dataset, kind: str) -> str | None:
    """The reason why a method that needs a kind of file cannot run; ``None`` if it can."""
    if kind == "labels" and sides.labels_as is None:
        return "it needs label maps and their --labels-as"
    try:
        _having(sides, *KINDS[kind])
    except ValueError as error:
        return str(error)
    return None


def _complete(sides: Dataset, needs: Collection[str], note: Note) -> Dataset:
    """The frames that lack no kind of file; ``note`` gets the number of the others."""
    kinds = [KINDS[kind] for kind in KINDS if kind in needs]
    words = [word for _, word in kinds]
    complete = _having(sides, lambda f: all(has(f) for has, _ in kinds), " and ".join(words))
    before, after = len(sides.frames), len(complete.frames)
    if after < before:
        lack = " or ".join(words)
        note(f"{before - after} of {before} frames are left out: they lack {lack}")
    return complete


def _measured(
    methods: Mapping[str, Method], sides: Dataset, used: Dataset, protocol: Protocol, note: Note
) -> dict[str, list[Row]]:
    """The rows of each method: of single frames, and with the steps. Ground truth counts all
    frames of ``sides``."""
    map_side, query_side = (used.select(role=role) for role in ROLES)
    references, queries = (Viewpoints.of(s.frames, sides) for s in (map_side, query_side))
    truth = true_matches(protocol.true, references, queries, note)

    def row(matches: Matches, details: Row) -> Row:
        recognition = Recognition(references, queries, matches, details=details)
        return measure(recognition, truth, protocol.convention).metrics

    rows: dict[str, list[Row]] = {}
    retrievals: dict[str, Retrieval] = {}
    for name, method in methods.items():
        try:
            retrieval = _retrieval(method, map_side, query_side, protocol)
        except ValueError as error:
            rows[name] = [_not_run(method.name, str(error))]
            continue
        temporal = getattr(method, "temporal", None)
        details = {"method": method.name, "temporal": temporal, "steps": None, **retrieval.costs}
        rows[name] = [row(retrieval.matches, details)]
        if stepped := retrieval.stepped:
            rows[name].append(row(stepped.matches, {**details, "steps": stepped.used}))
        retrievals[name] = retrieval
    if protocol.fused and set(protocol.fused) <= set(retrievals):
        try:
            rows[_FUSED] = [
                row(recognised.matches, details)
                for recognised, details in _fused(retrievals, queries, references, protocol)
            ]
        except ValueError as error:
            rows[_FUSED] = [_not_run(" + ".join(protocol.fused), str(error))]
    return rows


def _not_run(method: str, reason: str) -> Row:
    return {"method": method, "reason": reason}


def _retrieval(
    method: Method, references: Dataset, queries: Dataset, protocol: Protocol
) -> Retrieval:
    """A method run on the files of both sides."""
    if isinstance(method, StoredDescriptors):
        frames = [*references.frames, *queries.frames]
        method.read({frame.frame: frame.image or frame.label for frame in frames})
    as_paper = protocol.steps == AS_PAPER and method.name not in protocol.fused
    with protocol.progress(method.name, len([*references.frames, *queries.frames])) as bar:
        return run(
            method,
            _views(method, queries, protocol.workers),
            _views(method, references, protocol.workers),
            top=TOP,
            progress=bar.advance,
            steps=None if as_paper else protocol.steps,
        )


def _fused(
    retrievals: Mapping[str, Retrieval],
    queries: Viewpoints,
    references: Viewpoints,
    protocol: Protocol,
) -> Iterator[tuple[Recognised, Row]]:
    """The recognition by several methods together, of single frames, and followed if that is a
    step, each with its details. A method without vectors is a ValueError."""
    by_name = {name: retrievals[name].descriptors for name in protocol.fused}
    several = {name: both for name, both in by_name.items() if both}
    for name in by_name.keys() - several.keys():
        raise ValueError(f"{name} makes no vectors or signs, expected such for --fuse")
    sequences, of_map = ([*map(sequence_of, side.frames)] for side in (queries, references))
    costs = [retrievals[name].costs for name in protocol.fused]
    details = {
        "method": " + ".join(protocol.fused),
        "temporal": None,
        "bytes_a_reference": sum(cost["bytes_a_reference"] for cost in costs),
        **{
            name: {key: sum(cost[name][key] for cost in costs) for key in costs[0][name]}
            for name in ("encode_ms", "match_ms")
        },
    }
    alone = replace(protocol.steps, follow=None, delay=0)
    trust = {name: both.trust for name, both in several.items()}
    town = references_of({n: both.references for n, both in several.items()}, of_map, trust)
    described = {name: both.queries for name, both in several.items()}
    for steps in dict.fromkeys((alone, protocol.steps)):
        recognised = recognise(described, sequences, town, steps, TOP)
        used = recognised.used
        yield recognised, {**details, "steps": used, "weights": used["weights"]}


def _views(method: Method, side: Dataset, workers: int) -> Iterator[View]:
    """References or queries as the method needs them: with label maps, images, or neither."""
    if not method.needs:
        yield from (View(frame.frame) for frame in side.frames)
        return
    labels_as = side.labels_as
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
