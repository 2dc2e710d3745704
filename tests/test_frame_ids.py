import pytest

from ssrvlad_torch.datasets.names import name_of, sequence_of, split_id


@pytest.mark.parametrize(
    ("frame", "sequence", "name"),
    [("monday/7", "monday", "7"), ("town/monday/7", "town/monday", "7"), ("7", "", "7")],
)
def test_an_id_is_cut_at_its_last_slash(frame, sequence, name):
    assert split_id(frame) == (sequence, name)
    assert (sequence_of(frame), name_of(frame)) == (sequence, name)
