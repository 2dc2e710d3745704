"""`ssrvlad compare`: one data set, many methods."""

import json
from itertools import chain

import numpy as np
import pytest
from drives import write_maps, write_photos, write_truth
from PIL import Image

from ssrvlad_torch.datasets.synthetic_city import write_city

CAMVID = ("--labels-as", "camvid-11")
SMALL = ("--set", "cohog.size=128")


@pytest.fixture
def compare(ssrvlad):
    """Runs the command; returns exit code, rows by method, and the lines of stderr. Of the two
    rows of a method it is that of single frames."""

    def run(*arguments: object):
        code, out, err = ssrvlad("compare", *arguments, "--json")
        rows = json.loads(out)["rows"] if out else []
        return code, {row["method"]: row for row in rows if not row.get("steps")}, err

    return run


@pytest.fixture
def town(tmp_path):
    """Two drives past six places, with images and label maps, and the truth."""
    for drive in ("query", "reference"):
        write_photos(tmp_path / "town" / drive / "images", range(6), ".jpg")
        write_maps(tmp_path / "town" / drive / "labels", range(6))
    truth = {f"query/{n:03d}": [f"reference/{n:03d}"] for n in range(6)}
    write_truth(tmp_path / "town" / "ground_truth.json", truth)
    return tmp_path / "town"


def test_methods_on_label_maps_and_on_images_of_one_data_set(compare, town):
    names = ("ssr-vlad", "label-grid", "hog", "tiny-image", "cohog")
    settings = ("--set", "ssr-vlad.temporal=0", "--set", "hog.rows=2", *SMALL)
    code, rows, err = compare(town, "--method", ",".join(names), *CAMVID, *settings)
    assert (code, err, tuple(rows)) == (0, [], names)
    for row in rows.values():
        assert (row["queries"], row["references"], row["queries_with_match"]) == (6, 6, 6)
        assert row["recall_at"] == {"1": 1, "5": 1, "10": 1}
        assert row["auc_pr"] == row["recall_at_100_precision"] == 1
        assert row["intervals"]["auc_pr"] == [1, 1]
        for cost in (row["encode_ms"], row["match_ms"]):
            assert 0 < cost["min"] <= cost["average"] <= cost["max"]
    assert rows["hog"]["bytes_a_reference"] == 2 * 10 * 8 * 4
    assert rows["label-grid"]["bytes_a_reference"] == 480 * 4


@pytest.mark.parametrize("method", ["label-grid", "hog"])
def test_a_ground_truth_counts_by_a_convention(compare, town, tmp_path, method):
    truth = {f"query/{n:03d}": [] for n in range(3)}
    truth |= {"query/004": ["reference/001"], "query/005": ["reference/005"]}
    file = write_truth(tmp_path / "truth.json", truth)
    options = ("--method", method, *CAMVID, "--ground-truth", file, "--convention", "vpr-tutorial")
    row = compare(town, *options)[1][method]
    assert (row["queries"], row["queries_with_match"], row["recall_at"]["1"]) == (5, 2, 0.5)


def test_every_method_with_the_steps_that_it_can_take(ssrvlad, tmp_path):
    for drive in ("query", "reference"):
        write_photos(tmp_path / "town" / drive / "images", range(12), ".jpg")
        write_maps(tmp_path / "town" / drive / "labels", range(12))
    names = "ssr-vlad,label-grid,hog,cohog"
    options = ("--method", names, *CAMVID, "--tolerance-frames", 0, "--json", *SMALL)
    rows = json.loads(ssrvlad("compare", tmp_path / "town", *options)[1])["rows"]
    assert [row["method"] for row in rows[::2]] == names.split(",")
    for single, stepped in zip(rows[::2], rows[1::2], strict=True):
        assert (single["method"], single["steps"]) == (stepped["method"], None)
        assert stepped["steps"]["standardise"] == {"query": False}, "of twelve frames"
        assert stepped["recall_at"]["1"] >= single["recall_at"]["1"]
    without = ("--no-standardise", "--no-sweep", "--follow", "no")
    rows = json.loads(ssrvlad("compare", tmp_path / "town", *options, *without)[1])["rows"]
    assert [row["method"] for row in rows] == names.split(",")


def test_methods_taken_together(ssrvlad, tmp_path):
    """The rows of each stay as they were; two more are those of single frames and followed."""
    for drive in ("query", "reference"):
        write_photos(tmp_path / "town" / drive / "images", range(32), ".jpg")
        write_maps(tmp_path / "town" / drive / "labels", range(32))
    options = (tmp_path / "town", "--method", "label-grid,hog", *CAMVID, "--tolerance-frames", 0)
    alone = json.loads(ssrvlad("compare", *options, "--json")[1])["rows"]
    code, out, _ = ssrvlad("compare", *options, "--fuse", "hog,label-grid", "--json")
    *rows, single, followed = json.loads(out)["rows"]
    assert code == 0
    for row, before in zip(rows, alone, strict=True):
        for key in ("method", "recall_at", "steps"):
            assert row[key] == before[key]
    for row, mode in ((single, "no"), (followed, "offline")):
        assert row["method"] == "hog + label-grid"
        assert row["steps"]["standardise"] == {"query": True}
        assert row["steps"]["follow"] == {"query": mode}
        assert sum(row["weights"]["query"].values()) == pytest.approx(1)
        assert row["recall_at"]["1"] >= max(one["recall_at"]["1"] for one in rows) - 0.01
    assert single["bytes_a_reference"] == 2 * 480 * 4


@pytest.mark.parametrize("names", ["hog", "hog,hog", "hog,tiny-image"])
def test_what_cannot_be_taken_together(ssrvlad, town, names):
    code, _, err = ssrvlad("compare", town, "--method", "hog,label-grid", "--fuse", names)
    assert (code, len(err)) == (2, 1)
    assert f"--fuse: expected two or more of hog, label-grid, got {names!r}" in err[0]


def test_a_member_that_does_not_run(compare, town):
    code, rows, _ = compare(town, "--method", "hog,ssr-vlad", "--fuse", "hog,ssr-vlad")
    assert code == 3
    assert rows["hog + ssr-vlad"]["reason"] == "ssr-vlad does not run"


def test_a_member_that_fails_on_a_frame(compare, town):
    Image.fromarray(np.full((60, 80), 99, np.uint8)).save(town / "query" / "labels" / "003.png")
    code, rows, _ = compare(town, "--method", "hog,ssr-vlad", "--fuse", "hog,ssr-vlad", *CAMVID)
    assert code == 3
    assert "99" in rows["ssr-vlad"]["reason"]
    assert rows["hog + ssr-vlad"]["reason"] == "ssr-vlad does not run"


def test_the_tables(ssrvlad, town):
    code, out, err = ssrvlad("compare", town, "--method", "label-grid,hog,lost-x", *CAMVID)
    assert (code, len(err)) == (3, 1)
    assert err[0].startswith("ssrvlad: skipped lost-x: no network: ")
    for words in ("1.00-1.00", "Recall@100%", "label-grid", "not run", "bytes a reference"):
        assert words in out
    assert "6 queries (6 with a true match) against 6 references, convention exact" in out


def test_what_a_method_lacks_is_its_row(compare, town, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    methods = ("--method", "ssr-vlad,hog,netvlad")
    code, rows, err = compare(town, *methods)
    assert code == 3
    assert rows["hog"]["recall_at"]["1"] == 1
    assert rows["ssr-vlad"] == {
        "method": "ssr-vlad",
        "reason": "it needs label maps and their --labels-as",
    }
    assert f"no weights at {tmp_path}/.cache/ssrvlad/weights" in rows["netvlad"]["reason"]
    assert [line.split(":")[1] for line in err] == [" skipped ssr-vlad", " skipped netvlad"]

    for picture in town.glob("query/images/*"):
        picture.unlink()
    code, rows, err = compare(town, *methods, *CAMVID)
    assert (code, rows["ssr-vlad"]["queries"]) == (3, 6)
    assert rows["hog"]["reason"] == f"no query of {town} (folders) has an image"
    assert err[0] == "ssrvlad: 6 of 12 frames have no image, the first is query/000"


def test_nothing_that_can_run(ssrvlad, compare, town):
    code, rows, err = compare(town, "--method", "label-grid")
    assert (code, len(rows), len(err)) == (3, 1, 1)
    code, out, _ = ssrvlad("compare", town, "--method", "label-grid")
    assert (code, "not run" in out, "bytes" in out) == (3, True, False)


def test_a_frame_that_cannot_be_read_is_the_reason(compare, town):
    (town / "query" / "images" / "003.jpg").write_text("no image")
    code, rows, err = compare(town, "--method", "hog,label-grid", *CAMVID)
    assert (code, len(err)) == (3, 1)
    assert "003.jpg: is no image file" in rows["hog"]["reason"]
    assert rows["label-grid"]["queries"] == 6


def test_all_methods_get_the_same_frames(compare, town):
    """Images of one place and the label map of another are missing."""
    (town / "query" / "labels" / "001.png").unlink()
    (town / "reference" / "images" / "002.jpg").unlink()
    _, rows, err = compare(town, "--method", "hog,label-grid", *CAMVID)
    assert {(row["queries"], row["references"]) for row in rows.values()} == {(5, 5)}
    assert {row["queries_with_match"] for row in rows.values()} == {4}
    assert "ssrvlad: 2 of 12 frames are left out: they lack an image or a label map" in err
    _, rows, _ = compare(town, "--method", "hog", *CAMVID)
    assert (rows["hog"]["queries"], rows["hog"]["references"]) == (6, 5)


def test_sequences_by_name_and_other_label_maps(compare, tmp_path):
    for drive in ("monday", "today", "never"):
        write_photos(tmp_path / "photos" / drive, range(4), ".jpg")
        write_maps(tmp_path / "maps" / drive, range(4))
    labels = ("--labels", tmp_path / "maps", *CAMVID)
    names = ("--references", "mon*", "--queries", "today")
    methods = ("--method", "label-grid,hog", "--tolerance-frames", 0)
    code, rows, err = compare(tmp_path / "photos", *names, *labels, *methods)
    assert (code, err) == (0, [])
    assert [row["recall_at"]["1"] for row in rows.values()] == [1, 1]

    folders = ("--references", tmp_path / "photos/monday", "--queries", tmp_path / "photos/today")
    again = compare(*folders, *labels, *methods)[1]
    assert [row["recall_at"]["1"] for row in again.values()] == [1, 1]
    assert {row["references"] for row in chain(rows.values(), again.values())} == {4}


def test_a_png_is_a_label_map_or_an_image_but_not_both(compare, maps, tmp_path):
    drives = ("--references", maps, "--queries", write_maps(tmp_path / "today", range(6)))
    methods = ("--method", "label-grid,hog", "--tolerance-frames", 0)
    code, rows, _ = compare(*drives, *methods, *CAMVID)
    assert (code, rows["label-grid"]["recall_at"]["1"]) == (3, 1)
    assert rows["hog"]["reason"] == f"no reference of {maps} (folders) has an image"
    code, rows, _ = compare(*drives, *methods)
    assert code == 3
    assert "expected a photograph, got a label map" in rows["hog"]["reason"]
    assert rows["label-grid"]["reason"] == "it needs label maps and their --labels-as"


def test_odd_against_even_frames(ssrvlad, compare, maps, tmp_path):
    options = (*CAMVID, "--tolerance-frames", 1)
    code, rows, err = compare(maps, "--odd-even", "--method", "ssr-vlad", *options)
    assert (code, err) == (0, [])
    db = tmp_path / "even.ssrdb"
    ssrvlad("encode", maps, "-o", db, *CAMVID, "--every", 2)
    odd = ("--every", 2, "--start", 1, "--tolerance-frames", 1, "--json")
    odd += ("--no-standardise", "--no-sweep", "--follow", "no")
    metrics = json.loads(ssrvlad("evaluate", db, maps, *odd)[1])
    assert (metrics["references"], metrics["queries"]) == (3, 3)
    for key in ("recall_at", "auc_pr", "queries", "references", "queries_with_match"):
        assert rows["ssr-vlad"][key] == metrics[key]


def test_poses(compare, tmp_path):
    write_city(tmp_path / "city", frames=8, seed=1, size=(60, 80))
    labels = ("--labels-as", "cityscapes-trainids", "--method", "label-grid")
    by_file = compare(tmp_path / "city", *labels)[1]["label-grid"]
    by_pose = compare(tmp_path / "city", *labels, "--tolerance-metres", 5)[1]["label-grid"]
    for key in ("recall_at", "auc_pr", "queries_with_match"):
        assert by_file[key] == by_pose[key]
    poses = (tmp_path / "city" / "poses.csv").read_text().splitlines(keepends=True)
    (tmp_path / "city" / "poses.csv").write_text("".join(poses[:-2]))
    _, rows, err = compare(tmp_path / "city", *labels, "--tolerance-metres", 5)
    assert rows["label-grid"]["queries"] + rows["label-grid"]["references"] == 14
    assert "2 of 16 frames have no pose" in err[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--method hog", "expected the folder of a data set, or folders as --references and"),
        ("--method hog --references town/query", "or folders as --references and --queries"),
        ("--method hog --references town/query --queries a --layout auto", "--layout and --odd"),
        ("--method hog --odd-even", "--layout and --odd-even need the folder of a data set"),
        ("town --method hog --odd-even --queries query", "--odd-even takes the queries from"),
        ("town --method hog,orb", "unknown method 'orb'; expected one of ssr-vlad"),
        ("town --method hog --set rows=3", "--set: expected METHOD.NAME=VALUE for one of hog, got"),
        ("town --method hog --set cohog.size=3", "for one of hog, got 'cohog.size'"),
        ("town --method hog --set hog.rows=0", "the grid must be 1 x 1 or more, got 0 x 10"),
        ("town --method hog --set hog.rows=many", "method hog cannot take rows='many'"),
        ("town --method hog --references nope", "town has no sequence 'nope'; it has query"),
        ("town/query --method hog", "does not say which of query is a reference; name it"),
        ("town --method hog --tolerance-metres 5", "no reference of town (folders) has a pose"),
        ("none --method hog", "none is no folder"),
        ("town", "Missing option '--method'"),
    ],
)
def test_wrong_use_is_one_line(ssrvlad, town, monkeypatch, arguments, message):
    monkeypatch.chdir(town.parent)
    code, out, err = ssrvlad("compare", *arguments.split())
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]
