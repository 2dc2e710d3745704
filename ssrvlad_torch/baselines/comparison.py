"""Other methods on the files of references and queries: every query against all references, with
the costs, and measured."""

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils._pytree import tree_leaves

from ..channels.channel import Channel, View
from ..datasets.dataset import Dataset, DatasetFrame, GroundTruth
from ..datasets.frame_files import FrameFile, read_ahead
from ..datasets.image_files import read_image
from ..datasets.label_files import read_label_map
from ..datasets.sides import ROLES
from ..evaluation.ground_truth import Viewpoints, true_matches
from ..evaluation.measure import TOP, Recognition, measure
from ..evaluation.metrics import Convention
from ..recognition.matching import Matches
from ..recognition.recognise import (
    AS_PAPER,
    Recognised,
    Steps,
    recognise,
    recognise_by_scores,
    references_of,
)
from ..taxonomy import label_space
from .protocol import Method, noting
from .stored_descriptors import StoredDescriptors


class Retrieval(NamedTuple):
    """Candidates of every query, and the costs.

    Attributes:
        matches: ``(Q, top)``; if references have equal scores, the earlier comes first.
        costs: milliseconds of a query as ``average``, ``min`` and ``max``, ``encode_ms`` without
            reading it from disk, ``match_ms`` of all scores, without ranking them; and
            ``bytes_a_reference``, encoded.
        stepped: the result of the steps of `recognition`, if there are steps.
    """

    matches: Matches
    costs: dict[str, Any]
    stepped: Recognised | None = None


def run(
    method: Method,
    queries: Iterable[View],
    references: Iterable[View],
    top: int = 10,
    progress: Callable[[int], None] = lambda _: None,
    steps: Steps | None = None,
) -> Retrieval:
    """Encodes the references, then the queries one by one; the first query is encoded twice and
    timed the second time. ``progress`` is called with 1 for every frame. One that the method
    refuses is a ValueError.

    Steps, whose costs are not measured, give a second result. The sweep needs signs, or a method
    with ``encode_sweep``."""
    map_sequences, sequences = list[str](), list[str]()
    encoded = method.encode_reference(noting(references, map_sequences, progress))
    sweep = getattr(method, "encode_sweep", None) if steps and steps.sweep else None
    matches, inputs = list[Matches](), list[Tensor]()
    encode_ms, match_ms = list[float](), list[float]()
    for frame in noting(queries, sequences, progress):
        if not matches:
            method.scores(method.encode_query([frame]), encoded)
        begin = time.perf_counter()
        encodings = method.encode_query([frame])
        between = time.perf_counter()
        scores = method.scores(encodings, encoded)
        match_ms.append(1e3 * (time.perf_counter() - between))
        encode_ms.append(1e3 * (between - begin))
        padded = F.pad(scores.float(), (0, max(0, top - scores.shape[1])), value=-torch.inf)
        ranked, rows = (x[:, :top] for x in padded.sort(dim=1, descending=True, stable=True))
        matches.append(Matches(ranked, rows.masked_fill(ranked == -torch.inf, -1)))
        if steps:
            swept = sweep([frame]) if sweep else encodings
            inputs.append(swept if isinstance(method, Channel) else scores)
    costs = {
        "encode_ms": _cost(encode_ms),
        "match_ms": _cost(match_ms),
        "bytes_a_reference": encoded_bytes(encoded) / len(map_sequences),
    }
    retrieval = Retrieval(Matches(*map(torch.cat, zip(*matches, strict=True))), costs)
    if not steps:
        return retrieval
    if isinstance(method, Channel):
        town = references_of({method.name: encoded}, map_sequences)
        stepped = recognise({method.name: torch.cat(inputs)}, sequences, town, steps, top)
    else:
        stepped = recognise_by_scores(torch.cat(inputs), sequences, map_sequences, steps, top)
    return retrieval._replace(stepped=stepped)


def encoded_bytes(encodings: Any) -> int:
    """Bytes of the tensors in encodings."""
    leaves = tree_leaves(encodings)
    return sum(leaf.nbytes for leaf in leaves if isinstance(leaf, Tensor))


def _cost(times: list[float]) -> dict[str, float]:
    return {"average": sum(times) / len(times), "min": min(times), "max": max(times)}


Row = dict[str, Any]
"""The metrics and costs of a method, or its name and the reason why it could not run."""

Note = Callable[[str], object]
KINDS: dict[str, tuple[Callable[[DatasetFrame], object], str]] = {
    "images": (lambda frame: frame.image, "an image"),
    "labels": (lambda frame: frame.label, "a label map"),
}
"""The kinds of files that a method may need of a frame, each also in words."""

_AHEAD = 16


class ComparisonSettings(NamedTuple):
    """How methods are measured: what is a true match, the convention, the steps to a decision, the
    threads that read ahead, and what shows the progress of a method."""

    true: GroundTruth
    convention: Convention
    steps: Steps
    workers: int
    progress: Callable[[str, int], AbstractContextManager[Any]]


def compare(
    methods: Mapping[str, Method | str], sides: Dataset, settings: ComparisonSettings, note: Note
) -> list[Row]:
    """The rows of all methods, of single frames and with the steps; a method that cannot be made is
    given by the reason. ``note`` gets what is left out of ``sides``, see `open_sides`."""
    used = sides
    if settings.true.metres is not None:
        used = _having(sides, lambda frame: frame.has_pose, "a pose")
    lacking = {kind: reason for kind in KINDS if (reason := _lacks(used, kind))}
    rows: dict[str, list[Row]] = {}
    able: dict[str, Method] = {}
    for name, method in methods.items():
        if isinstance(method, str):
            rows[name] = [_not_run(name, method)]
        elif kinds := sorted(method.needs & lacking.keys()):
            rows[name] = [_not_run(name, lacking[kinds[0]])]
        else:
            able[name] = method
    if able:
        needs = {need for method in able.values() for need in method.needs}
        rows |= _measured(able, sides, _complete(used, needs, note), settings, note)
    return [row for name in methods for row in rows[name]]


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
    methods: Mapping[str, Method],
    sides: Dataset,
    used: Dataset,
    settings: ComparisonSettings,
    note: Note,
) -> dict[str, list[Row]]:
    """The rows of each method. Ground truth counts all frames of ``sides``."""
    map_side, query_side = (used.select(role=role) for role in ROLES)
    references, queries = (Viewpoints.of(s.frames, sides) for s in (map_side, query_side))
    truth = true_matches(settings.true, references, queries, note)

    def row(matches: Matches, details: Row) -> Row:
        recognition = Recognition(references, queries, matches, details=details)
        return measure(recognition, truth, settings.convention).metrics

    rows: dict[str, list[Row]] = {}
    steps = None if settings.steps == AS_PAPER else settings.steps
    for name, method in methods.items():
        try:
            if isinstance(method, StoredDescriptors):
                method.read({frame.frame: frame.image or frame.label for frame in used.frames})
            views = (_views(method, side, settings.workers) for side in (query_side, map_side))
            with settings.progress(name, len(used.frames)) as bar:
                retrieval = run(method, next(views), next(views), TOP, bar.advance, steps)
        except ValueError as error:
            rows[name] = [_not_run(name, str(error))]
            continue
        temporal = getattr(method, "temporal", None)
        details = {"method": name, "temporal": temporal, "steps": None, **retrieval.costs}
        rows[name] = [row(retrieval.matches, details)]
        if stepped := retrieval.stepped:
            rows[name].append(row(stepped.matches, {**details, "steps": stepped.used}))
    return rows


def _not_run(method: str, reason: str) -> Row:
    return {"method": method, "reason": reason}


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

    files = side.files("label" if space else "image")
    for file, view in read_ahead(load, files, workers, _AHEAD):
        if isinstance(view, ValueError):
            raise ValueError(f"{file.path}: {view}") from view
        yield view
