"""References and queries: parts of one data set, or two folders."""

import json

from drives import write_maps, write_photos

from ssrvlad_torch.datasets.synthetic_city import write_city

CAMVID = ("--labels-as", "camvid-11")


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


def test_odd_even_gives_the_metrics_of_evaluate(ssrvlad, compare, maps, tmp_path):
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
