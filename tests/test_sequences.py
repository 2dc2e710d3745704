"""Which frames stand together."""

import pytest

from ssrvlad_torch.recognition.sequences import runs


def test_the_rows_of_each_sequence_are_a_range():
    assert list(runs(["a", "a", "b"])) == [range(0, 2), range(2, 3)]
    assert list(runs([])) == []


def test_frames_that_do_not_stand_together_are_refused():
    with pytest.raises(ValueError, match="frames of 'a' together, got some at 2"):
        list(runs(["a", "b", "a"]))
