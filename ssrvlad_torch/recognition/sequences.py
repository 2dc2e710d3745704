"""Sequences: which frames stand together, how they run a map, and which share the mean that is
subtracted (Schubert, Neubert and Protzel, ICRA 2020). It needs no torch."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import NamedTuple

from ..native.headers import model


def runs(sequences: Sequence[str]) -> Iterator[range]:
    """Rows of each sequence; rows of one that do not stand together are a ValueError."""
    first, names = 0, set[str]()
    for sequence, rows in groupby(sequences):
        if sequence in names:
            raise ValueError(f"expected the frames of {sequence!r} together, got some at {first}")
        names.add(sequence)
        last = first + len(list(rows))
        yield range(first, last)
        first = last


FORWARDS, BACKWARDS = 1, -1
"""Ways to run a map."""

SAME_PLACE_ROWS = int(model("Place")["near"])
"""Rows at most so far apart show the same place."""


class Course(NamedTuple):
    """How queries run a map: `FORWARDS` or `BACKWARDS`, at a rate in rows of the map a
    frame, and as how many streams whose frames alternate."""

    way: int = FORWARDS
    rate: float = 1
    streams: int = 1

    def __str__(self) -> str:
        words = (
            "backwards" * (self.way == BACKWARDS),
            f"at rate {self.rate:g}" * (self.rate != 1),
            f"{self.streams} streams in turn" * (self.streams != 1),
        )
        return ", ".join(word for word in words if word)


MIN_FRAMES = int(model("Place")["min_frames"])
"""Least number of frames of a sequence whose mean is subtracted. The mean of fewer frames describes
their place: subtracting it lowered Recall@1 of single pictures on CamVid, swept, from 0.84 to
0.69."""


def sharing(frames: Sequence[int]) -> dict[tuple[int, ...], tuple[int, ...]]:
    """Groups of sequences that share a mean, and for each group the sequences whose frames make the
    mean. Sequences are numbers in the order of the map; ``frames`` holds their numbers of frames.

    A sequence of `MIN_FRAMES` frames has a mean of its own. Adjacent shorter sequences, such as the
    folders of a drive that was cut up, share a mean; if they still have too few frames, the mean of
    all is used. With fewer than `MIN_FRAMES` frames in all there is no mean."""
    sequences = tuple(range(len(frames)))
    if sum(frames) < MIN_FRAMES:
        return {}
    shared: dict[tuple[int, ...], tuple[int, ...]] = {}
    for short, run in groupby(sequences, lambda number: frames[number] < MIN_FRAMES):
        together = tuple(run)
        for group in [together] if short else [(number,) for number in together]:
            enough = sum(frames[number] for number in group) >= MIN_FRAMES
            shared[group] = group if enough else sequences
    return shared
