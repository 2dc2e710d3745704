"""Ground truth from files of every form, and what is wrong with others."""

import json

import numpy as np
import pytest
from helpers import refuses

from ssrvlad_torch.evaluation.ground_truth_files import from_file

QUERIES = ("a", "b")
REFERENCES = ("day/1", "day/2", "day/10")
MATRIX = np.array([[1, 0, 1], [0, 0, 0]])


def as_lists(truth):
    assert all(rows.dtype == np.int64 for rows in truth if rows is not None)
    return [None if rows is None else rows.tolist() for rows in truth]


@pytest.fixture
def read(tmp_path):
    """Writes a file and reads it as the ground truth of `QUERIES` and `REFERENCES`."""

    def write_and_read(name, content, queries=QUERIES, references=REFERENCES):
        path = tmp_path / name
        if isinstance(content, str | bytes):
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        elif name.endswith(".json"):
            path.write_text(json.dumps(content))
        elif isinstance(content, dict):
            np.savez(path, **content)
        else:
            np.save(path, content)
        return as_lists(from_file(path, queries, references)[0])

    return write_and_read


FORMS = {
    "mapping.json": {"b": [], "a": ["day/10", "day/1"], "unasked": ["nowhere"]},
    "pairs.csv": "query,reference\na,day/10\na,day/1\nb,\n",
    "other columns.csv": "\ufeffreference, x, query\r\nday/1,0,a\r\nday/10,,a\r\n,,b\r\n",
    "bool.npy": MATRIX.astype(bool),
    "float.npy": MATRIX.astype(float),
    "fortran.npy": np.asfortranarray(MATRIX),
    "matrix.npz": {"truth": MATRIX},
    "tutorial.npz": {"GThard": MATRIX.T, "GTsoft": np.ones((3, 2))},
    "vpr_bench.json": [[0, [2, 0, 2]], [1, []]],
    "vpr_bench in another order.json": [[1, []], [0, [0, 2]]],
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_file_gives_the_same_truth(read, name):
    assert read(name, FORMS[name]) == [[0, 2], []]


def test_a_query_without_an_entry_has_unknown_matches(read):
    for name, content in (
        ("some.json", {"a": ["day/2"]}),
        ("some.csv", "query,reference\na,day/2,\n"),
    ):
        assert read(name, content) == [[1], None]
        assert read(name, content, ["b", "a", "a"]) == [None, [1], [1]]
    pairs = "query,reference\nb,day/1\na,day/10\nb,day/2\nb,day/1\n"
    assert read("pairs.csv", pairs) == [[2], [0, 1]]


def test_an_entry_may_be_the_end_of_a_path(read):
    """As long an end as its writer took: longer than the id, or shorter. Of references the id
    itself comes first."""
    paths = {f"labels/{n}": f"/d/day/labels/{n}" for n in (1, 2)}
    paths |= {f"night/labels/{n}": f"/d/night/labels/{n}" for n in (2, 3)}
    entries = {"x/1": ["day/labels/2", "labels/2", "labels/3", "night/labels/2"]}
    assert read("t.json", entries, ["x/1"], paths) == [[1, 2, 3]]
    entries = {"day/labels/1": [], "3": ["b"], "dusk/labels/2": ["nowhere"], "labels/3": ["a"]}
    assert read("t.json", entries, paths, ["a", "b"]) == [[], None, None, [0, 1]]
    with pytest.raises(ValueError, match="has an entry '2', which may be /d/day/labels/2 or /d"):
        read("t.json", {"2": []}, paths, ["a"])
    with pytest.raises(ValueError, match=r"'labels/2', which may be .*day/labels/2 or .*night/lab"):
        read("t.json", {"labels/2": []}, paths, ["a"])
    with pytest.raises(ValueError, match="names reference 'ight/labels/3', which is not"):
        read("t.json", {"a": ["ight/labels/3"]}, ["a"], paths)


def test_an_entry_may_have_the_suffix_of_the_file_and_be_a_whole_path(read):
    """As the listing of a folder writes it. A dot in the name of a frame is no suffix."""
    paths = {f"{day}/000002": f"/d/{day}/images/000002" for day in ("dawn", "evening")}
    paths |= {"evening/12.5": "/d/evening/images/12.5"}
    for entry in (
        "evening/images/000002.jpg",
        "./evening/images//000002.PNG",
        "/d/evening/images/000002.jpg",
        "/d/evening/images/000002",
        "evening/000002.jpg",
        "evening/000002",
    ):
        assert read("t.json", {entry: [entry]}, paths, paths) == [None, [1], None], entry
    for entry in ("12.5", "12.5.jpg", "images/12.5.tif"):
        assert read("t.json", {entry: []}, paths, ["a"]) == [None, None, []]
    for entry in ("12.6", "12.5.txt", "000002.5", "/evening/images/000002.jpg", "/"):
        refuses("has an entry for none of the 3 queries", read, "t.json", {entry: []}, paths, ["a"])
    with pytest.raises(ValueError, match=r"'000002\.jpg', which may be /d/dawn/.* or /d/evening/"):
        read("t.json", {"000002.jpg": []}, paths, ["a"])
    assert read("t.json", {"a.jpg": ["b"]}, ["a", "a.jpg"], ["b"]) == [None, [0]]


REFUSED = [
    ("a.json", "{", "cannot read the ground truth .*a.json"),
    ("a.json", "", "cannot read the ground truth"),
    ("a.json", "[" * 100_000, "cannot read the ground truth"),
    ("a.json", 3, "a.json: expected .*query id.* or "),
    ("a.json", {"a": "day/1"}, "expected"),
    ("a.json", {"a": [1]}, "expected"),
    ("a.json", {"c": []}, "has an entry for none of the 2 queries, as a"),
    ("a.json", {"a": ["day/3"]}, "names reference 'day/3', which is not in the database"),
    ("a.csv", "", "expected a first line query,reference"),
    ("a.csv", "query,reference\na,day/1,day/2\n", "line 2: more cells than columns"),
    ("a.csv", "query,reference\na,day/3\n", "names reference 'day/3'"),
    ("a.npy", MATRIX.T, r"is a matrix of shape \(3, 2\), expected \(2, 3\)"),
    ("a.npy", MATRIX * 0.5, "is not a matrix of 0 and 1"),
    ("a.npy", MATRIX * np.nan, "is not a matrix of 0 and 1"),
    ("a.json", '{"q/0": [], "q/1": [], "q/0": []}', "key 'q/0' is there more than once"),
    ("a.npy", b"", "cannot read the ground truth"),
    ("a.npz", b"PK", "cannot read the ground truth"),
    ("a.npz", {"x": MATRIX, "y": MATRIX}, "expected one matrix, or GThard, got x, y"),
    ("a.json", [[0, []]], "has 1 rows, expected one for each of 2 queries"),
    ("a.json", [[0, []], [0, []]], "has query 0 in row 1, expected each of 2 once"),
    ("a.json", [[0, []], [1, [0, 3]]], "names reference 3 of query 1; .* has 3"),
    ("a.json", [[0, [-1]], [1, []]], "names reference -1 of query 0"),
    ("a.json", [[0, [0.5]], [1, []]], "of whole numbers"),
    ("a.npy", np.array([[0, [1]]], object), r"pickle, which can run any code; .*json\.dumps"),
    ("a.mat", b"", r"a\.mat: expected a file in \.json, \.csv, \.npy, \.npz"),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED)
def test_other_files_are_refused(read, name, content, message):
    refuses(message, read, name, content)


def test_a_missing_file_is_refused(tmp_path):
    for path in (tmp_path / "missing.json", tmp_path):
        refuses(r"No such file|expected a file", from_file, path, QUERIES, REFERENCES)
