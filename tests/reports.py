"""Evaluations to report, and the page that comes of them, taken apart; shared by the tests."""

from collections.abc import Callable, Mapping, Sequence
from html.parser import HTMLParser
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from helpers import descriptors

from ssrvlad_torch.database.frames import FrameSet
from ssrvlad_torch.datasets.image_files import Pixels
from ssrvlad_torch.evaluation.measure import Evaluation, Recognition, measure
from ssrvlad_torch.evaluation.metrics import Convention
from ssrvlad_torch.evaluation.report import render
from ssrvlad_torch.recognition.matching import match
from ssrvlad_torch.recognition.sweep import score

VOID = {"meta", "link", "img", "input", "br"}


def frame_set(vectors: torch.Tensor, sequence: str = "drive") -> FrameSet:
    """Frames of one sequence, ten metres apart on a line."""
    count = len(vectors)
    poses = np.stack([np.arange(count) * 10.0, np.zeros(count), np.zeros(count)], 1)
    return FrameSet(
        frames=tuple(f"{sequence}/{row:04d}" for row in range(count)),
        sequences=(sequence,) * count,
        channels={"descriptor": vectors},
        poses=poses,
        stamps=np.full(count, np.nan),
        empty=~vectors.any(dim=1).numpy(),
    )


def noisy(queries: int, references: int, noise: float = 2.0, seed: int = 0, length: int = 24):
    """Queries and references; query n looks like reference n, the more noise the less."""
    there = descriptors(seed, references, length)
    here = there[torch.arange(queries) % max(references, 1)] if references else there[:0]
    wander = descriptors(seed + 1, len(here), length)
    amount = torch.linspace(0, noise, len(here))[:, None]
    return frame_set(here + amount * wander, "query"), frame_set(there, "reference")


class Drawn(NamedTuple):
    """The material of a report: the cosines of all pairs, and pictures of any frame."""

    pairs: npt.NDArray[np.float32]
    query: Callable[[str], Mapping[str, Pixels]] = lambda _: {}

    def part(self, queries):
        return self._replace(pairs=self.pairs[queries])

    def cosines(self, queries, references):
        return self.pairs[np.ix_(queries, references)]

    def reference(self, frame):
        return self.query(frame)


def evaluation_of(
    queries: FrameSet,
    references: FrameSet,
    truth: Sequence[Sequence[int]],
    convention: Convention = "exact",
    pictures: Callable[[str], Mapping[str, Pixels]] = lambda _: {},
) -> Evaluation:
    """Matching by cosine, measured."""
    pairs = score(queries.descriptors, references.descriptors).numpy()
    matches = match(queries.descriptors, references.descriptors, 10)
    truth = [np.array(rows, np.int64) for rows in truth]
    recognition = Recognition(references, queries, matches, Drawn(pairs, pictures))
    return measure(recognition, truth, convention)


class Page(HTMLParser):
    """A page taken apart; elements that are not closed where they should be are an error.

    Attributes:
        tags: ``(name, attributes)`` in order.
        texts: ``(names of the elements around, text)`` in order, without blank ones.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[tuple[tuple[str, ...], str]] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag, f"{tag} closed inside another element"

    def handle_data(self, data):
        if data.strip():
            self.texts.append((tuple(self._open), data))

    def all(self, tag: str, kind: str | None = None) -> list[dict[str, str]]:
        """Attributes of the elements of a name, and of a class."""
        found = (attributes for name, attributes in self.tags if name == tag)
        return [a for a in found if kind is None or kind in a.get("class", "").split()]

    @property
    def words(self) -> str:
        """All that is read, in order."""
        shown = (text for around, text in self.texts if not {"style", "script"} & {*around})
        return " ".join(" ".join(shown).split())


def page_of(evaluation: Evaluation, title="town", settings=None, notes=()) -> Page:
    """The page of an evaluation."""
    return Page(render(evaluation, title, settings or {}, notes))
