"""Sequences of a map: which share the mean that is subtracted (Schubert, Neubert and Protzel, ICRA
2020), and how near rows show one place. It needs no torch."""

from collections.abc import Sequence
from itertools import groupby

from ..native.headers import model

SAME_PLACE_ROWS = int(model("Place")["near"])
"""Rows at most so far apart show the same place."""

MIN_FRAMES = int(model("Place")["min_frames"])
"""Least number of frames of a sequence whose mean is subtracted."""


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
