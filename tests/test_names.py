"""Names of sequences: short, and never two alike."""

import pytest

from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.names import names_of


def test_a_folder_alone_is_named_by_its_last_part():
    assert names_of(["/data/monday"]) == {"/data/monday": "monday"}
    assert names_of(["s3://bucket/monday"]) == {"s3://bucket/monday": "monday"}


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["/d/00/labels", "/d/01/labels", "/d/park"], ["00/labels", "01/labels", "park"]),
        (["/a/x/y", "/b/x/y"], ["a/x/y", "b/x/y"]),
    ],
)
def test_folders_of_one_name_take_as_much_of_their_paths_as_they_need(folders, names):
    assert list(names_of(folders).values()) == names


def test_a_path_that_ends_another_cannot_be_told_apart():
    with pytest.raises(ValueError, match="/y needs a name that no sequence has"):
        names_of(["/y", "/b/y"])


def test_names_that_are_taken_stay(tmp_path):
    known = {str(tmp_path): "labels"}
    assert names_of(["/other/labels", str(tmp_path)], known) == {
        "/other/labels": "other/labels",
        str(tmp_path): "labels",
    }
    with pytest.raises(ValueError, match=r"'labels' was encoded from /none/labels, which is gone"):
        names_of(["/other/labels"], {"/none/labels": "labels"})


def test_sources_stay_in_the_order_in_which_they_are_given(tmp_path):
    """It is the order of time; a glob is sorted as a person would."""
    for folder in ("morning", "evening", "day10", "day9"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "1.png").touch()
    sources = [str(tmp_path / name) for name in ("morning", "evening", "day*")]
    found = [file.sequence for file in find_label_files(sources)]
    assert found == ["morning", "evening", "day9", "day10"]
