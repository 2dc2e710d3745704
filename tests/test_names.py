"""Names of sequences: short, and never two alike."""

import pytest
from helpers import refuses

from ssrvlad_torch.datasets.names import (
    check_sequences,
    sequence_names,
)


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["/data/monday"], ["monday"]),
        (["s3://bucket/monday"], ["monday"]),
        (["/d/00/labels", "/d/01/labels", "/d/park"], ["00/labels", "01/labels", "park"]),
        (["/a/x/y", "/b/x/y"], ["a/x/y", "b/x/y"]),
        (["/d/day.npy", "/d/run.v2.bag"], ["day", "run.v2"]),
    ],
)
def test_folders_take_as_much_of_their_paths_as_they_need(folders, names):
    assert sequence_names(folders) == dict(zip(folders, names, strict=True))


def test_folders_that_would_share_a_name_are_refused():
    """A path that ends another; a stack, a bag or a video, and the folder beside it."""
    refuses("/y needs a name that no sequence has", sequence_names, ["/y", "/b/y"])
    for suffix in (".npy", ".bag", ".mp4"):
        refuses("needs a name that no sequence has", sequence_names, ["/d/day", f"/d/day{suffix}"])
        with pytest.raises(ValueError, match=rf"'day' of the database is /d/day, not .*{suffix}"):
            check_sequences([(f"/d/day{suffix}", "day")], [("/d/day", "day")])


def test_folders_of_the_map_keep_their_names(tmp_path):
    """By a link too. The name of another is the same if it comes with the known ones or later."""
    (tmp_path / "monday").mkdir()
    (tmp_path / "link").symlink_to("monday")
    link, other = str(tmp_path / "link"), "/other/labels"
    folders = [(str(tmp_path / "monday"), "labels")]
    assert sequence_names([other, link], folders) == {other: "other/labels", link: "labels"}
    folders = [("s3://d/00/labels", "00/labels"), ("s3://d/01/labels", "01/labels")]
    assert sequence_names(["s3://d/02/labels"], folders) == {"s3://d/02/labels": "02/labels"}


@pytest.mark.parametrize(
    ("folders", "message"),
    [
        (
            [("/none/labels", "labels")],
            "'labels' of the database was encoded from /none/labels, wh",
        ),
        ([("", "labels")], "'labels' of the database has no known folder: .* --sequence labels"),
        (
            [("/other/labels", "even"), ("/other/labels", "odd")],
            "/other/labels is sequence 'even' and sequence 'odd' of the database: .* --sequence",
        ),
    ],
)
def test_a_folder_that_may_be_two_sequences_is_refused(folders, message):
    refuses(message, sequence_names, ["/other/labels"], folders)


def test_sequences_of_two_databases_are_one_where_a_folder_is():
    here = [("s3://a/day", "labels"), ("s3://a/night", "labels"), ("", "own")]
    check_sequences([("s3://a/day", "labels"), ("s3://c", "c"), ("s3://d", "own")], here)
    with pytest.raises(ValueError, match="'labels' of the database is s3://a/day, not s3://b/day"):
        check_sequences([("s3://b/day", "labels")], here)
