"""Ground truth from poses and from frame numbers."""

import json
import math
import shutil

import numpy as np
import pytest
from helpers import refuses, write_maps, write_photos, write_truth
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch.evaluation.ground_truth import from_frame_numbers, from_poses
from ssrvlad_torch.evaluation.ground_truth_files import from_file


def as_lists(truth):
    assert all(rows.dtype == np.int64 for rows in truth)
    return [rows.tolist() for rows in truth]


def test_the_distance_includes_its_limit_and_ignores_the_heading():
    references = np.array([[0, 0, 0], [3, 4, 1], [3, 4.01, 0], [-5, 0, 2]], float)
    queries = np.array([[0, 0, 9], [100, 0, math.nan]], float)
    assert as_lists(from_poses(queries, references, 5)) == [[0, 1, 3], []]
    assert as_lists(from_poses(queries, references, 0)) == [[0], []]
    assert as_lists(from_poses(queries, np.pad(references, ((0, 0), (0, 1))), 0)) == [[0], []]
    assert as_lists(from_poses(queries[:0], references, 5)) == []
    assert as_lists(from_poses(queries, references[:0], 5)) == [[], []]


def test_headings_are_compared_the_shorter_way_round():
    """Limits included; x and y are all alike. 359 and 2 degrees are 3 degrees apart."""
    there = np.radians([0, 10, 90, 180, 350, -90, 359])
    references = np.column_stack((np.zeros((7, 2)), there))
    here = np.radians([0, 2, 90 + 720, 270])
    queries = np.column_stack((np.zeros((4, 2)), here))
    expected = [[0, 1, 4, 6], [0, 1, 6], [2], [5]]
    assert as_lists(from_poses(queries, references, 1, degrees=10)) == expected
    assert as_lists(from_poses(queries[:1], references, 1, degrees=180)) == [[*range(7)]]
    assert as_lists(from_poses(queries[2:3], references, 1, degrees=0)) == [[2]]
    # both the distance and the heading count
    references = np.array([[0, 0, 0], [9, 0, 0], [0, 0, math.pi]])
    assert as_lists(from_poses(references[:1], references, 5, degrees=45)) == [[0]]


def test_queries_and_references_of_unknown_pose_are_left_out():
    known, holed = np.zeros((3, 3)), np.array([[math.nan, 0, 0], [0, 0, 0], [0, 0, math.nan]])
    assert [rows is None for rows in from_poses(holed, known, 5)] == [True, False, False]
    assert [rows is None for rows in from_poses(holed, known, 5, 9)] == [True, False, True]
    assert as_lists(from_poses(known[:1], holed, 5)) == [[1, 2]]
    assert as_lists(from_poses(known[:1], holed, 5, 9)) == [[1]]


def test_two_aligned_traverses_are_counted_apart():
    """In the order of names, whatever the order of the lists."""
    queries = ["night/10", "night/9", "night/11"]
    references = ["day/x3", "day/x1", "day/x2"]
    assert as_lists(from_frame_numbers(queries, references, 0)) == [[2], [1], [0]]
    assert as_lists(from_frame_numbers(queries, references, 1)) == [[0, 1, 2], [1, 2], [0, 2]]
    # a sequence may have slashes
    assert as_lists(from_frame_numbers(["a/b/1"], ["a/b/1", "a/c/1"], 9)) == [[0]]


POSE, UNKNOWN = np.zeros((1, 3)), np.full((2, 3), math.nan)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((POSE, POSE, -1), "0 metres or more"),
        ((POSE, POSE, math.nan), "0 metres or more"),
        ((POSE, POSE, math.inf), "0 metres or more and finite, got inf"),
        ((POSE, POSE, 1, -1), "0 degrees or more"),
        ((POSE, POSE, 1, math.nan), "0 degrees or more"),
        ((UNKNOWN, POSE, 1), "none of 2 queries has a pose; a tolerance in metres requires"),
        ((POSE, UNKNOWN, 1), "none of 2 references has a pose"),
        ((POSE, POSE[:, :2], 1, 9), "none of 1 references has a heading; a tolerance in degrees"),
        ((["a/1"], ["a/1"], -1), "0 frames or more, got -1"),
        ((["night/1"], ["day/1", "day/2"], 1), "length, got 1 query frames and 2 reference frames"),
        ((["night/1"], ["a/1", "b/1"], 1), r"query sequence 'night'.*\(a, b\)"),
        ((["a/1", "night/1"], ["a/1"], 1), r"query sequence 'night'.*\(a\)"),
        ((["a/1", "night/1"], ["a/1", "b/1"], 1), r"query sequence 'night'.*\(a, b\)"),
    ],
)
def test_wrong_tolerances_and_unaligned_traverses_are_refused(given, message):
    refuses(message, from_poses if isinstance(given[0], np.ndarray) else from_frame_numbers, *given)


FRAMES = st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 120)), min_size=1, unique=True)


@given(FRAMES, FRAMES, st.integers(0, 4))
@example([("a", 9), ("a", 3), ("a", 11)], [("a", n) for n in (2, 4, 6, 8, 10)], 1)  # 10 follows 9
@example([("a", 2)], [("a", 1), ("a", 2), ("a", 30)], 1)  # places, not numbers; itself
@example([("b", 1), ("a", 2)], [("a", 1), ("a", 2), ("b", 1), ("b", 2)], 0)
def test_frame_numbers_equal_a_loop(queries, references, reach):
    references += [("a", 1000), ("b", 1000)]
    drives = {name: sorted({n for s, n in queries + references if s == name}) for name in "ab"}
    expected = [
        [
            row
            for row, (there, number) in enumerate(references)
            if there == here
            and abs(drives[here].index(number) - drives[here].index(asked)) <= reach
        ]
        for here, asked in queries
    ]
    ids = [[f"{sequence}/{number}" for sequence, number in f] for f in (queries, references)]
    assert as_lists(from_frame_numbers(*ids, reach)) == expected


# ---- ground truth from files of every form, and what is wrong with others


QUERIES = ("a", "b")
REFERENCES = ("day/1", "day/2", "day/10")
MATRIX = np.array([[1, 0, 1], [0, 0, 0]])


def lists_of(truth):
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
        else:
            np.save(path, content)
        return lists_of(from_file(path, queries, references)[0])

    return write_and_read


FORMS = {
    "mapping.json": {"b": [], "a": ["day/10", "day/1"], "unasked": ["nowhere"]},
    "pairs.csv": "query,reference\na,day/10\na,day/1\nb,\n",
    "other columns.csv": "\ufeffreference, x, query\r\nday/1,0,a\r\nday/10,,a\r\n,,b\r\n",
    "bool.npy": MATRIX.astype(bool),
    "float.npy": MATRIX.astype(float),
    "fortran.npy": np.asfortranarray(MATRIX),
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
    ("a.json", [[0, []]], "has 1 rows, expected one for each of 2 queries"),
    ("a.json", [[0, []], [0, []]], "has query 0 in row 1, expected each of 2 once"),
    ("a.json", [[0, []], [1, [0, 3]]], "names reference 3 of query 1; .* has 3"),
    ("a.json", [[0, [-1]], [1, []]], "names reference -1 of query 0"),
    ("a.json", [[0, [0.5]], [1, []]], "of whole numbers"),
    ("a.npy", np.array([[0, [1]]], object), r"pickle, which can run any code; .*json\.dumps"),
    ("a.mat", b"", r"a\.mat: expected a file in \.json, \.csv, \.npy$"),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED)
def test_other_files_are_refused(read, name, content, message):
    refuses(message, read, name, content)


def test_a_missing_file_is_refused(tmp_path):
    for path in (tmp_path / "missing.json", tmp_path):
        refuses(r"No such file|expected a file", from_file, path, QUERIES, REFERENCES)


# ---- ground truths that count frames: by the frames of the data set, not by those that are used


CAMVID = ("--labels-as", "camvid-11")
COUNTS = ("references", "queries", "queries_with_match")
ROLES = [("--role", "reference"), ("--role", "query")]


@pytest.fixture
def bench(tmp_path):
    """A VPR-Bench data set of six places, with the label maps of both drives beside it; of the
    queries, numbers 1 and 4 have no true match."""
    root = tmp_path / "bench"
    for folder in ("query", "ref"):
        write_photos(root / folder, range(6), ".jpg")
        write_maps(tmp_path / "maps" / folder, range(6))
    rows = enumerate([[0], [], [2], [3], [], [5]])
    write_truth(root / "ground_truth_new.json", [*rows])
    return root


@pytest.fixture
def recognise(ssrvlad, bench, tmp_path):
    """Encodes the references and evaluates the queries, with options of both and of each."""
    maps = ("--layout", "vpr-bench", "--labels", tmp_path / "maps", *CAMVID)

    def run(encoding: tuple[object, ...] = (), querying: tuple[object, ...] = ()):
        """The exit code, references, queries, those with a match, RecallRate@1; and stderr."""
        db = tmp_path / "bench.ssrdb"
        shutil.rmtree(db, ignore_errors=True)
        assert ssrvlad("encode", bench, "-o", db, *maps, *ROLES[0], *encoding)[0] in (0, 3)
        code, out, err = ssrvlad(
            "evaluate", db, bench, *maps, *ROLES[1], "--temporal", 0, *querying, "--json"
        )
        metrics = json.loads(out) if out else {"recall_at": {"1": None}}
        figures = (metrics.get(name) for name in COUNTS)
        return (code, *figures, metrics["recall_at"]["1"]), err

    return run


def test_numbers_of_the_truth_count_images_not_label_maps(recognise, tmp_path):
    """The label map of the second query and that of the first reference are missing: the truth
    still speaks of the same images."""
    assert recognise() == ((0, 6, 6, 4, 1.0), [])
    (tmp_path / "maps" / "query" / "001.png").unlink()
    (tmp_path / "maps" / "ref" / "000.png").unlink()
    figures, err = recognise()
    assert figures == (0, 5, 5, 3, 1.0)
    assert err == [
        "ssrvlad: 1 of 6 frames have no label map, the first is query/001",
        f"ssrvlad: 1 references of {tmp_path}/bench/ground_truth_new.json are not in the "
        "database, the first is ref/000",
    ]


ODD = ("--every", 2, "--start", 1)


@pytest.mark.parametrize(("frames", "with_match"), [(1, 2), (0, 0)])
def test_frames_of_the_tolerance_are_those_of_the_data_set(recognise, frames, with_match):
    near = ("--tolerance-frames", frames, "--every", 3, "--start", 1)
    assert recognise(("--every", 3), near)[0][:4] == (0, 2, 2, with_match)


def test_a_matrix_is_of_all_frames(recognise, tmp_path):
    matrix = ("--ground-truth", write_truth(tmp_path / "truth.npy", np.eye(6)))
    assert recognise(querying=(*matrix, *ODD))[0] == (0, 6, 3, 3, 1.0)
    small = ("--ground-truth", write_truth(tmp_path / "small.npy", np.eye(3)))
    figures, err = recognise(querying=(*small, *ODD))
    assert (figures[0], len(err)) == (2, 1)
    assert "is a matrix of shape (3, 3), expected (6, 6)" in err[0]
