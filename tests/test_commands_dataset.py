"""Data sets on the command line: `--layout`, `--split`, `--role` and `--labels`."""

import json

import pytest

from ssrvlad_torch.datasets.synthetic_city import write_city

CAMVID = ("--labels-as", "camvid-11")


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """Eight frames of both drives through the city; not to be changed."""
    folder = tmp_path_factory.mktemp("made") / "city"
    write_city(folder, frames=8, seed=1, size=(60, 80))
    return folder


@pytest.fixture
def reference(ssrvlad, city, tmp_path):
    """A database of the references, the roles being those of the data set."""
    space = ("--labels-as", "cityscapes-trainids")
    db = tmp_path / "roles.ssrdb"
    code, out, _ = ssrvlad(
        "encode", city, "-o", db, *space, "--layout", "auto", "--role", "reference"
    )
    assert (code, "8 frames encoded" in out) == (0, True)
    return db


def test_roles_and_truth_come_from_the_data_set(ssrvlad, city, reference, tmp_path):
    db = tmp_path / "folders.ssrdb"
    ssrvlad("encode", city / "reference", "-o", db, "--labels-as", "cityscapes-trainids")
    truth = ("--ground-truth", city / "ground_truth.json")
    by_folders = ssrvlad("evaluate", db, city / "query", *truth, "--json")
    whole = ("evaluate", reference, city, "--layout", "auto", "--role", "query")
    assert ssrvlad(*whole, "--json") == by_folders
    assert json.loads(by_folders[1])["queries"] == 8
    assert ssrvlad(*whole, "--tolerance-metres", 5, "--json")[1] == by_folders[1]
    assert ssrvlad(*whole[:3], "--layout", "folders", "--split", "q*", "--json") == by_folders


def test_a_query_of_a_data_set(ssrvlad, city, reference):
    lines = [
        ssrvlad("query", reference, *where, "--top", 2)[1]
        for where in ((city / "query",), (city, "--layout", "auto", "--split", "query"))
    ]
    assert lines[0] == lines[1] != ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--layout", "auto", "--split", "nope"), "city has no sequence 'nope'; it has query, ref"),
        (("--split", "query"), "--split, --role and --labels need --layout, such as --layout auto"),
        (("--role", "query"), "need --layout"),
        (("--layout", "auto", "--sequence", "foo"), "--sequence, --poses, --topic and --fps do no"),
        (("--labels", "maps"), "need --layout"),
        (("--layout", "synthia"), "city is not in the layout synthia: expected"),
        (("--layout", "kitti"), "unknown layout 'kitti'; expected one of extended-cmu"),
        (("--layout", "auto", "--role", "loop"), "'loop' is not one of 'reference', 'query'"),
        (("--layout", "auto", "--labels", "nowhere"), "label maps in nowhere need a label space"),
    ],
)
def test_wrong_use_of_a_data_set(ssrvlad, city, reference, options, message):
    for command in ("query", "evaluate"):
        code, out, err = ssrvlad(command, reference, city, *options)
        assert (code, out, len(err)) == (2, "", 1)
        assert message in err[0]


def test_a_data_set_is_one_folder(ssrvlad, city, reference):
    code, _, err = ssrvlad("query", reference, city, city, "--layout", "auto")
    assert (code, err) == (
        2,
        ["ssrvlad: --layout: expected the folder of one data set, got 2 sources"],
    )


def test_headings_can_count(ssrvlad, city, reference):
    counts = []
    for limit in ((), ("--tolerance-degrees", 180), ("--tolerance-degrees", 0)):
        arguments = ("evaluate", reference, city / "query", "--tolerance-metres", 5, *limit)
        counts.append(json.loads(ssrvlad(*arguments, "--json")[1])["queries_with_match"])
    assert counts == [8, 8, 0]
