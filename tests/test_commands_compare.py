"""`ssrvlad compare`: one data set, many methods."""

from helpers import write_truth

CAMVID = ("--labels-as", "camvid-11")


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
