"""Sequences: which frames stand together."""

import itertools
from collections.abc import Iterator, Sequence


def runs(sequences: Sequence[str]) -> Iterator[range]:
    """Rows of each sequence; rows of one that do not stand together are a ValueError."""
    first, names = 0, set[str]()
    for sequence, rows in itertools.groupby(sequences):
        if sequence in names:
            raise ValueError(f"expected the frames of {sequence!r} together, got some at {first}")
        names.add(sequence)
        last = first + len(list(rows))
        yield range(first, last)
        first = last
