"""Selection of references."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.database.frames import FrameSet
from ssrvlad_torch.datasets.names import sequence_of, split_id
from ssrvlad_torch.files import natural_key
from ssrvlad_torch.search.selection import neighbours


def frame_set(*frames):
    """Frames without descriptors, in natural order."""
    ordered = sorted(frames, key=lambda frame: tuple(map(natural_key, split_id(frame))))
    return FrameSet(
        frames=tuple(ordered),
        sequences=tuple(sequence_of(frame) for frame in ordered),
        channels={"descriptor": torch.zeros(len(ordered), 0)},
        poses=np.zeros((len(ordered), 3)),
        stamps=np.zeros(len(ordered)),
        empty=np.zeros(len(ordered), bool),
    )


@given(st.sets(st.integers(0, 30)), st.integers(0, 40), st.integers(0, 5))
def test_neighbours_are_the_frames_around_the_position_of_a_query(numbers, query, reach):
    references = frame_set("a/5", "z/5", *(f"m/{number}" for number in numbers))
    [(first, last)] = neighbours([f"m/{query}"], references, reach)
    found = [int(frame[2:]) for frame in references.frames[first:last]]
    below = sorted(n for n in numbers if n < query)
    above = sorted(n for n in numbers if n > query)
    expected = below[len(below) - min(reach, len(below)) :] + [query] * (query in numbers)
    assert found == expected + above[:reach]
