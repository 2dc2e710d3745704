"""Data sets on the command line: `--layout`, `--split`, `--role` and `--labels`."""

import json

import pytest

from ssrvlad_torch.datasets.synthetic_city import write_city

SPACE = ("--labels-as", "cityscapes-trainids")


@pytest.fixture
def city(tmp_path):
    """Eight frames of both drives through the city."""
    write_city(tmp_path / "city", frames=8, seed=1, size=(60, 80))
    return tmp_path / "city"


@pytest.fixture
def reference(ssrvlad, city, tmp_path):
    """A database of the references, the roles being those of the data set."""
    db = tmp_path / "roles.ssrdb"
    options = (*SPACE, "--layout", "auto", "--role", "reference")
    code, out, _ = ssrvlad("encode", city, "-o", db, *options)
    assert (code, "8 frames encoded" in out) == (0, True)
    return db


def test_roles_and_truth_come_from_the_data_set(ssrvlad, city, reference, tmp_path):
    db = tmp_path / "folders.ssrdb"
    ssrvlad("encode", city / "reference", "-o", db, *SPACE)
    truth = ("--ground-truth", city / "ground_truth.json")
    by_folders = ssrvlad("evaluate", db, city / "query", *truth, "--json")
    whole = ("evaluate", reference, city, "--layout", "auto", "--role", "query")
    assert ssrvlad(*whole, "--json") == by_folders
    assert json.loads(by_folders[1])["queries"] == 8
    assert ssrvlad(*whole, "--tolerance-metres", 5, "--json")[1] == by_folders[1]
    assert ssrvlad(*whole[:3], "--layout", "folders", "--split", "q*", "--json") == by_folders
    places = ((city / "query",), (city, "--layout", "auto", "--split", "query"))
    lines = [ssrvlad("query", reference, *where, "--top", 2)[1] for where in places]
    assert lines[0] == lines[1] != ""
    for limit, count in (((), 8), ((180,), 8), ((0,), 0)):
        options = ("--tolerance-metres", 5, *(("--tolerance-degrees", *limit) if limit else ()))
        out = ssrvlad("evaluate", reference, city / "query", *options, "--json")[1]
        assert json.loads(out)["queries_with_match"] == count, "headings can count"


WRONG = [
    ("--layout auto --split nope", "city has no sequence 'nope'; it has query, ref"),
    ("--split query", "--split, --role and --labels need --layout, such as --layout auto"),
    ("--role query", "need --layout"),
    ("--layout auto --sequence foo", "--sequence, --poses, --topic and --fps do no"),
    ("--labels maps", "need --layout"),
    ("--layout synthia", "city is not in the layout synthia: expected"),
    ("--layout kitti", "unknown layout 'kitti'; expected one of extended-cmu"),
    ("--layout auto --role loop", "'loop' is not one of 'reference', 'query'"),
    ("--layout auto --labels nowhere", "label maps in nowhere need a label space"),
    ("other --layout auto", "--layout: expected the folder of one data set, got 2 sources"),
]


def test_wrong_use_of_a_data_set(ssrvlad, city, reference):
    for options, message in WRONG:
        for command in ("query", "evaluate"):
            code, out, err = ssrvlad(command, reference, city, *options.split())
            assert (code, out, len(err)) == (2, "", 1), options
            assert message in err[0]
