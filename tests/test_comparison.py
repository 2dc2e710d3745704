"""`ssrvlad compare`: methods on the same frames, each alone and with its steps."""

import json

import numpy as np
from helpers import write_maps, write_photos, write_truth, write_two_drives
from PIL import Image

from ssrvlad_torch.datasets.synthetic_city import write_city

CAMVID = ("--labels-as", "camvid-11")


def test_every_method_with_the_steps_that_it_can_take(ssrvlad, tmp_path):
    town, names = write_two_drives(tmp_path / "town", 12), "ssr-vlad,label-grid,hog,cohog"
    options = ("--method", names, *CAMVID, "--tolerance-frames", 0, "--json")
    rows = json.loads(ssrvlad("compare", town, *options)[1])["rows"]
    assert [row["method"] for row in rows[::2]] == names.split(",")
    for single, stepped in zip(rows[::2], rows[1::2], strict=True):
        assert (single["method"], single["steps"]) == (stepped["method"], None)
        assert stepped["steps"]["standardise"] == {"query": False}, "of twelve frames"
        assert stepped["recall_at"]["1"] >= single["recall_at"]["1"]
    without = ("--no-standardise", "--no-sweep", "--follow", "no")
    rows = json.loads(ssrvlad("compare", town, *options, *without)[1])["rows"]
    assert [row["method"] for row in rows] == names.split(",")


def test_a_method_that_fails_on_a_frame_does_not_run(compare, two_drives):
    unknown = Image.fromarray(np.full((60, 80), 99, np.uint8))
    unknown.save(two_drives / "query" / "labels" / "003.png")
    code, rows, _ = compare(two_drives, "--method", "hog,ssr-vlad", *CAMVID)
    assert code == 3
    assert "label id 99" in rows["ssr-vlad"]["reason"]


def test_the_reason_why_a_method_did_not_run_is_its_row(compare, two_drives, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    methods = ("--method", "ssr-vlad,hog,netvlad")
    code, rows, err = compare(two_drives, *methods)
    assert code == 3
    assert rows["hog"]["recall_at"]["1"] == 1
    reason = "it needs label maps and their --labels-as"
    assert rows["ssr-vlad"] == {"method": "ssr-vlad", "reason": reason}
    assert f"no weights at {tmp_path}/.cache/ssrvlad/weights" in rows["netvlad"]["reason"]
    assert [line.split(":")[1] for line in err] == [" skipped ssr-vlad", " skipped netvlad"]

    for picture in two_drives.glob("query/images/*"):
        picture.unlink()
    code, rows, err = compare(two_drives, *methods, *CAMVID)
    assert (code, rows["ssr-vlad"]["queries"]) == (3, 6)
    assert rows["hog"]["reason"] == "no query has an image"
    assert err[0] == "ssrvlad: 6 of 12 frames have no image, the first is query/000"


def test_a_frame_that_cannot_be_read_is_the_reason(compare, two_drives):
    (two_drives / "query" / "images" / "003.jpg").write_text("no image")
    code, rows, err = compare(two_drives, "--method", "hog,label-grid", *CAMVID)
    assert (code, len(err)) == (3, 1)
    assert "003.jpg: is no image file" in rows["hog"]["reason"]
    assert rows["label-grid"]["queries"] == 6


def test_all_methods_get_the_same_frames(compare, two_drives):
    """Images of one place and the label map of another are missing."""
    (two_drives / "query" / "labels" / "001.png").unlink()
    (two_drives / "reference" / "images" / "002.jpg").unlink()
    _, rows, err = compare(two_drives, "--method", "hog,label-grid", *CAMVID)
    assert {(row["queries"], row["references"]) for row in rows.values()} == {(5, 5)}
    assert {row["queries_with_match"] for row in rows.values()} == {4}
    assert "ssrvlad: 2 of 12 frames are left out: they lack an image or a label map" in err
    _, rows, _ = compare(two_drives, "--method", "hog", *CAMVID)
    assert (rows["hog"]["queries"], rows["hog"]["references"]) == (6, 5)


def test_methods_of_label_maps_and_of_images_are_compared_on_one_data_set(compare, two_drives):
    names = ("ssr-vlad", "label-grid", "hog", "tiny-image", "cohog")
    settings = ("--set", "ssr-vlad.temporal=0")
    code, rows, err = compare(two_drives, "--method", ",".join(names), *CAMVID, *settings)
    assert (code, err, tuple(rows)) == (0, [], names)
    for row in rows.values():
        assert (row["queries"], row["references"], row["queries_with_match"]) == (6, 6, 6)
        assert row["recall_at"] == {"1": 1, "5": 1, "10": 1}
        assert row["auc_pr"] == row["recall_at_100_precision"] == 1
        assert row["intervals"]["auc_pr"] == [1, 1]
        for cost in (row["encode_ms"], row["match_ms"]):
            assert 0 < cost["min"] <= cost["average"] <= cost["max"]
    assert rows["cohog"]["bytes_a_reference"] == 961 * 32 * 4
    assert rows["label-grid"]["bytes_a_reference"] == 480 * 4


def test_a_ground_truth_counts_by_a_convention(compare, two_drives, tmp_path):
    truth = {f"query/{n:03d}": [] for n in range(3)}
    truth |= {"query/004": ["reference/001"], "query/005": ["reference/005"]}
    file = write_truth(tmp_path / "truth.json", truth)
    options = (*CAMVID, "--ground-truth", file, "--convention", "vpr-bench")
    _, rows, _ = compare(two_drives, "--method", "label-grid,hog", *options)
    assert rows.keys() == {"label-grid", "hog"}
    for row in rows.values():
        assert (row["queries"], row["queries_with_match"], row["recall_at"]["1"]) == (5, 2, 0.2)


def test_the_tables_show_metrics_costs_and_what_did_not_run(ssrvlad, two_drives):
    code, out, err = ssrvlad("compare", two_drives, "--method", "label-grid,hog,lost-x", *CAMVID)
    assert (code, len(err)) == (3, 1)
    assert err[0].startswith("ssrvlad: skipped lost-x: no network: ")
    for words in ("1.00-1.00", "Recall@100%", "label-grid", "not run", "bytes a reference"):
        assert words in out
    assert "6 queries (6 with a true match) against 6 references, convention exact" in out
    code, out, err = ssrvlad("compare", two_drives, "--method", "label-grid")
    assert (code, len(err), "not run" in out, "bytes" in out) == (3, 1, True, False)


# ---- references and queries: parts of one data set, or two folders


def test_sequences_by_name_and_other_label_maps(compare, tmp_path):
    for drive in ("monday", "today", "never"):
        write_photos(tmp_path / "photos" / drive, range(4), ".jpg")
        write_maps(tmp_path / "maps" / drive, range(4))
    photos = tmp_path / "photos"
    methods = ("--labels", tmp_path / "maps", *CAMVID, "--method", "label-grid,hog")
    for drives in (
        (photos, "--references", "mon*", "--queries", "today"),
        ("--references", photos / "monday", "--queries", photos / "today"),
    ):
        code, rows, err = compare(*drives, *methods, "--tolerance-frames", 0)
        assert (code, err) == (0, [])
        figures = [(row["recall_at"]["1"], row["references"]) for row in rows.values()]
        assert figures == [(1, 4), (1, 4)]


def test_a_png_is_a_label_map_or_an_image_but_not_both(compare, maps, tmp_path):
    drives = ("--references", maps, "--queries", write_maps(tmp_path / "today", range(6)))
    methods = ("--method", "label-grid,hog", "--tolerance-frames", 0)
    code, rows, _ = compare(*drives, *methods, *CAMVID)
    assert (code, rows["label-grid"]["recall_at"]["1"]) == (3, 1)
    assert rows["hog"]["reason"] == "no reference has an image"
    code, rows, _ = compare(*drives, *methods)
    assert code == 3
    assert "expected a photograph, got a label map" in rows["hog"]["reason"]
    assert rows["label-grid"]["reason"] == "it needs label maps and their --labels-as"


def test_true_matches_come_from_poses_and_frames_without_are_noted(compare, tmp_path):
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
