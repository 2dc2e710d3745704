"""Selection of references."""

from itertools import compress

import numpy as np
import torch
from helpers import refuses
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.database.frames import FrameSet
from ssrvlad_torch.datasets.names import sequence_of, split_id
from ssrvlad_torch.files import natural_key
from ssrvlad_torch.search.selection import neighbours, select


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


FRAMES = frame_set("day/1", "day/2", "day/10", "night/3", "night/t1418132416", "night/x")


def test_sequences_are_selected_by_name():
    for sequences, expected in (
        (None, FRAMES.frames),
        (["night"], ("night/3", "night/t1418132416", "night/x")),
        ([], ()),
    ):
        assert tuple(compress(FRAMES.frames, select(FRAMES, sequences))) == expected
    refuses("there is no sequence 'dusk' in the database", select, FRAMES, ["night", "dusk"])


@given(st.sets(st.integers(0, 30)), st.integers(0, 40), st.integers(0, 5))
def test_neighbours_are_the_frames_around_the_position_of_a_query(numbers, query, reach):
    references = frame_set("a/5", "z/5", *(f"m/{number}" for number in numbers))
    [(first, last)] = neighbours([f"m/{query}"], references, reach)
    found = [int(frame[2:]) for frame in references.frames[first:last]]
    below = sorted(n for n in numbers if n < query)
    above = sorted(n for n in numbers if n > query)
    expected = below[len(below) - min(reach, len(below)) :] + [query] * (query in numbers)
    assert found == expected + above[:reach]


def test_a_query_of_another_sequence_has_no_neighbours():
    assert neighbours(["dusk/1"], FRAMES, 3).tolist() == [[0, 0]]
    refuses("0 or more frames, got -1", neighbours, [], FRAMES, -1)
