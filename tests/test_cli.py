"""The command line as a user meets it: output, exit codes, one-line errors."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import ROAD, SKY, VOID, blobs
from networks import photo, write_graph
from PIL import Image

from ssrvlad_torch import cli
from ssrvlad_torch.database import Database

COMMANDS = ["demo", "city", "encode", "query", "evaluate", "show", "db info", "bench"]


@pytest.fixture
def ssrvlad(monkeypatch, capsys):
    """Runs a command line; returns exit code, stdout and the lines of stderr."""

    def run(*arguments: object) -> tuple[int, str, list[str]]:
        monkeypatch.setattr("sys.argv", ["ssrvlad", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        out, err = capsys.readouterr()
        return end.value.code or 0, out, err.splitlines()

    return run


def write_maps(folder: Path, seeds: range) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        Image.fromarray(blobs(seed, 24, 32, 6)).save(folder / f"{seed:03d}.png")
    return folder


@pytest.fixture
def maps(tmp_path):
    return write_maps(tmp_path / "monday", range(6))


@pytest.fixture
def database(ssrvlad, maps, tmp_path):
    path = tmp_path / "town.ssrdb"
    assert ssrvlad("encode", maps, "-o", path, "--labels-as", "camvid-11")[0] == 0
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(ssrvlad, command):
    code, out, _ = ssrvlad(*command.split(), "--help")
    assert code == 0
    assert f"Example: ssrvlad {command}" in " ".join(out.split())


def test_city_then_encode_then_query_then_evaluate(ssrvlad, tmp_path):
    city, db = tmp_path / "city", tmp_path / "city.ssrdb"
    code, out, err = ssrvlad("city", city, "--frames", 8, "--seed", 1)
    assert (code, err) == (0, [])
    assert "8 reference and 8 query frames" in out

    code, out, _ = ssrvlad(
        "encode", city / "reference", "-o", db, "--labels-as", "cityscapes-trainids", "--json"
    )
    report = json.loads(out)
    assert code == 0
    assert (report["encoded"], report["already_there"], report["refused"]) == (8, 0, [])
    assert report["with_pose"] == 8

    code, out, _ = ssrvlad("query", db, city / "query", "--top", 3, "--json")
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert [line["query"] for line in lines] == [f"query/{n:06d}" for n in range(8)]
    for line in lines:
        scores = [candidate["score"] for candidate in line["candidates"]]
        assert len(scores) == 3
        assert scores == sorted(scores, reverse=True)
        assert all(c["frame"].startswith("reference/") for c in line["candidates"])

    truth = city / "ground_truth.json"
    code, out, _ = ssrvlad("evaluate", db, city / "query", "--ground-truth", truth, "--json")
    by_file = json.loads(out)
    assert code == 0
    assert {"recall_at", "auc_pr", "recall_at_100_precision", "fingerprint"} <= by_file.keys()
    assert (by_file["queries"], by_file["references"]) == (8, 8)
    assert set(by_file["recall_at"]) == {"1", "5", "10"}

    code, out, _ = ssrvlad("evaluate", db, city / "query", "--tolerance-metres", 5, "--json")
    assert json.loads(out) == by_file

    code, out, _ = ssrvlad("evaluate", db, city / "query", "--tolerance-frames", 1)
    assert "RecallRate@1" in out
    assert "AUC-PR" in out
    assert "Recall@100%Precision" in out


def test_a_query_finds_itself(ssrvlad, database, maps):
    code, out, _ = ssrvlad("query", database, maps, "--temporal", 0, "--top", 1)
    assert code == 0
    assert out.splitlines() == [f"monday/{n:03d}: monday/{n:03d} 1.0000" for n in range(6)]


def test_queries_that_are_in_the_database_are_mentioned(ssrvlad, database, maps):
    code, _, err = ssrvlad("evaluate", database, maps, "--tolerance-frames", 1)
    assert code == 0
    assert err == ["ssrvlad: 6 of 6 queries are in the database themselves"]


def test_odd_against_even_frames(ssrvlad, maps, tmp_path):
    db = tmp_path / "even.ssrdb"
    ssrvlad("encode", maps, "-o", db, "--labels-as", "camvid-11", "--every", 2)
    code, out, err = ssrvlad(
        "evaluate", db, maps, "--every", 2, "--start", 1, "--tolerance-frames", 1, "--json"
    )
    assert (code, err) == (0, [])
    assert (json.loads(out)["references"], json.loads(out)["queries"]) == (3, 3)


@pytest.fixture
def evaluate(ssrvlad, database, tmp_path):
    """Evaluates six frames of Tuesday, alike those of Monday, against Monday's database."""
    tuesday = write_maps(tmp_path / "tuesday", range(6))

    def run(*arguments: object) -> tuple[int, str, list[str]]:
        return ssrvlad("evaluate", database, tuesday, "--temporal", 0, *arguments)

    return run


def write_truth(path: Path, content: object) -> Path:
    if path.suffix == ".npy":
        np.save(path, content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def vpr_bench(matches: list[object]) -> np.ndarray:
    rows = np.empty((len(matches), 2), object)
    for query, references in enumerate(matches):
        rows[query, 0], rows[query, 1] = query, references
    return rows


def test_evaluate_names_its_convention_and_gives_intervals_and_thresholds(evaluate):
    code, out, err = evaluate("--tolerance-frames", 0, "--json")
    metrics = json.loads(out)
    assert (code, err) == (0, [])
    assert metrics["convention"] == "exact"
    figures = ("auc_pr", "average_precision", "recall_at_100_precision", "extended_precision")
    assert [metrics[name] for name in figures] == [1.0] * 4
    assert metrics["intervals"]["recall_at"]["1"] == metrics["intervals"]["auc_pr"] == [1.0, 1.0]
    assert metrics["roc_auc"] is None
    assert metrics["intervals"]["roc_auc"] == [None, None]
    points = metrics["thresholds"]
    assert points["at_precision"]["1"]["accepted"] == 6
    assert points["at_recall"]["0.5"]["precision"] == 1.0
    assert points["suggested"] is None


def test_evaluate_prints_all_figures(evaluate):
    code, out, _ = evaluate("--tolerance-frames", 0, "--at-recall", 0.25)
    assert code == 0
    for words in ("exact", "average precision", "ROC-AUC", "1.000 to 1.000", "recall 0.25"):
        assert words in out
    assert "suggested" in out


@pytest.mark.parametrize("convention", ["vpr-bench", "vpr-tutorial", "vpr-tutorial-single"])
def test_other_conventions(evaluate, convention):
    out = evaluate("--tolerance-frames", 1, "--convention", convention, "--json")[1]
    metrics = json.loads(out)
    assert metrics["convention"] == convention
    assert 0 < metrics["auc_pr"] <= 1
    assert (metrics["average_precision"] is None) == convention.startswith("vpr-tutorial")
    assert convention in evaluate("--tolerance-frames", 1, "--convention", convention)[1]


def test_an_empty_frame_is_no_obstacle_to_any_convention(evaluate, tmp_path):
    Image.fromarray(np.full((24, 32), VOID, np.uint8)).save(tmp_path / "tuesday" / "003.png")
    for convention in ("exact", "vpr-bench", "vpr-tutorial", "vpr-tutorial-single"):
        out = evaluate("--tolerance-frames", 0, "--convention", convention, "--json")[1]
        metrics = json.loads(out)
        assert metrics["recall_at"]["1"] == pytest.approx(5 / 6)
        assert metrics["auc_pr"] > 0.1


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("truth.json", {f"tuesday/{n:03d}": [f"monday/{n:03d}"] for n in range(6)}),
        ("truth.json", [[f"tuesday/{n:03d}", f"monday/{n:03d}"] for n in range(6)]),
        (
            "truth.csv",
            "query,reference\n" + "".join(f"tuesday/{n:03d},monday/{n:03d}\n" for n in range(6)),
        ),
        ("truth.csv", "\n".join(",".join(str(int(a == b)) for a in range(6)) for b in range(6))),
        ("truth.npy", np.eye(6)),
        ("ground_truth_new.npy", vpr_bench([[n] for n in range(6)])),
    ],
)
def test_every_form_of_ground_truth(evaluate, tmp_path, name, content):
    code, out, err = evaluate("--ground-truth", write_truth(tmp_path / name, content), "--json")
    assert (code, err) == (0, [])
    assert json.loads(out)["recall_at"]["1"] == 1.0


def test_queries_without_ground_truth_are_left_out_and_counted(evaluate, tmp_path):
    truth = {"tuesday/001": ["monday/001"], "tuesday/004": []}
    path = write_truth(tmp_path / "truth.json", truth)
    code, out, err = evaluate("--ground-truth", path, "--json")
    assert code == 0
    assert err == [f"ssrvlad: 4 of 6 queries are left out: {path} does not name them"]
    metrics = json.loads(out)
    assert (metrics["queries"], metrics["queries_with_match"]) == (2, 1)
    assert metrics["recall_at"]["1"] == 1.0


@pytest.mark.parametrize("how", ["frames", "matrix"])
def test_a_refused_query_keeps_its_place(evaluate, tmp_path, how):
    """What counts frames counts the unreadable one, too."""
    (tmp_path / "tuesday" / "002.png").write_text("no image")
    truth = write_truth(tmp_path / "truth.npy", np.eye(6))
    arguments = {"frames": ("--tolerance-frames", 0), "matrix": ("--ground-truth", truth)}[how]
    code, out, err = evaluate(*arguments, "--json")
    assert code == 3
    assert len(err) == 1
    metrics = json.loads(out)
    assert (metrics["queries"], metrics["recall_at"]["1"]) == (5, 1.0)


def test_headings_can_count(ssrvlad, tmp_path):
    city, db = tmp_path / "city", tmp_path / "city.ssrdb"
    ssrvlad("city", city, "--frames", 8, "--seed", 1)
    ssrvlad("encode", city / "reference", "-o", db, "--labels-as", "cityscapes-trainids")
    counts = []
    for degrees in (None, 180, 0):
        limit = [] if degrees is None else ["--tolerance-degrees", degrees]
        arguments = ("evaluate", db, city / "query", "--tolerance-metres", 5, *limit, "--json")
        counts.append(json.loads(ssrvlad(*arguments)[1])["queries_with_match"])
    assert counts == [8, 8, 0]


class Code:
    """A pickle of it calls a function."""

    def __reduce__(self):
        return print, ("run",)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", vpr_bench([[0]] * 5 + [[6]]), "names reference 6 of query 5; the database has 6"),
        ("a.npy", vpr_bench([[0]] * 5), "has 5 rows, wanted one for each of 6 queries"),
        ("a.npy", vpr_bench([Code()] * 6), "it asks for builtins.print; wanted nothing but arrays"),
        ("a.npy", np.eye(6, 5), "is a matrix of shape (6, 5), wanted (6, 6)"),
        ("a.json", {"tuesday/000": ["monday/6"]}, "names reference 'monday/6', which is not in"),
        ("a.txt", "", "wanted a ground truth in .json, .csv, .npy, .npz"),
    ],
)
def test_bad_ground_truth_is_one_line(evaluate, tmp_path, name, content, message):
    code, out, err = evaluate("--ground-truth", write_truth(tmp_path / name, content))
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]


def test_running_again_adds_only_what_is_missing(ssrvlad, database, maps):
    write_maps(maps, range(6, 9))
    code, out, _ = ssrvlad("encode", maps, "-o", database, "--labels-as", "camvid-11")
    assert code == 0
    assert "3 frames encoded (0 of them empty), 6 already there, 0 refused" in out


def test_info(ssrvlad, database):
    code, out, _ = ssrvlad("db", "info", database)
    assert code == 0
    assert "frames: 6" in out
    assert "sequences: monday 6" in out
    info = json.loads(ssrvlad("db", "info", database, "--json")[1])
    assert info["preset"] == "default"
    assert info["label_spaces"] == {"camvid-11": 6}
    assert info["config"]["rings"] == 5


def test_the_preset_of_a_database_is_used_again(ssrvlad, maps, tmp_path):
    db = tmp_path / "paper.ssrdb"
    ssrvlad("encode", maps, "-o", db, "--labels-as", "camvid-11", "--preset", "paper")
    write_maps(maps, range(6, 7))
    assert ssrvlad("encode", maps, "-o", db, "--labels-as", "camvid-11")[0] == 0
    assert json.loads(ssrvlad("db", "info", db, "--json")[1])["preset"] == "paper"
    code, _, err = ssrvlad(
        "encode", maps, "-o", db, "--labels-as", "camvid-11", "--preset", "default"
    )
    assert code == 2
    assert len(err) == 1
    assert "working_size None there and 120 here" in err[0]


def test_an_unreadable_frame_is_listed_and_the_rest_lands(ssrvlad, maps, tmp_path):
    whole = (maps / "002.png").read_bytes()
    (maps / "002.png").write_bytes(whole[: len(whole) // 2])
    Image.fromarray(np.full((24, 32), 77, np.uint8)).save(maps / "003.png")
    db = tmp_path / "some.ssrdb"
    code, out, err = ssrvlad("encode", maps, "-o", db, "--labels-as", "camvid-11")
    assert code == 3
    assert "4 frames encoded" in out
    assert "2 refused" in out
    assert [line.split(":")[1] for line in err] == [
        " refused monday/002",
        " refused monday/003",
    ]
    assert "label id 77 (768 pixels) is not in label space camvid-11" in err[1]


def test_an_empty_frame_is_counted_and_never_matches(ssrvlad, maps, tmp_path):
    Image.fromarray(np.full((24, 32), VOID, np.uint8)).save(maps / "000.png")
    db = tmp_path / "empty.ssrdb"
    out = ssrvlad("encode", maps, "-o", db, "--labels-as", "camvid-11")[1]
    assert "6 frames encoded (1 of them empty)" in out
    out = ssrvlad("query", db, maps, "--top", 6)[1]
    assert out.splitlines()[0] == "monday/000: no candidate"
    assert "monday/000 " not in out


def test_sizes_may_differ(ssrvlad, maps, tmp_path):
    Image.fromarray(blobs(3, 50, 41, 6)).save(maps / "003.png")
    assert ssrvlad("encode", maps, "-o", tmp_path / "db", "--labels-as", "camvid-11")[0] == 0


def test_show_writes_a_picture(ssrvlad, maps, tmp_path):
    picture = tmp_path / "frame.png"
    code, out, _ = ssrvlad("show", maps / "001.png", "-o", picture, "--labels-as", "camvid-11")
    assert (code, out.strip()) == (0, str(picture))
    assert Image.open(picture).size[0] > 1000


def test_demo(ssrvlad, tmp_path):
    code, out, err = ssrvlad("demo", "--out", tmp_path / "demo", "--frames", 8)
    assert (code, err) == (0, [])
    for metric in ("RecallRate@1", "AUC-PR", "Recall@100%Precision"):
        assert metric in out
    assert Image.open(tmp_path / "demo" / "demo.png").size[0] > 300
    assert ssrvlad("demo", "--out", tmp_path / "demo", "--frames", 8)[1] == out


def bad_uses(tmp_path: Path) -> dict[str, tuple[list[object], str]]:
    camvid = ["--labels-as", "camvid-11"]
    maps, db, none = tmp_path / "monday", tmp_path / "town.ssrdb", tmp_path / "none"
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("no folder")
    photo = tmp_path / "photo" / "a.png"
    photo.parent.mkdir()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (9, 9, 3), np.uint8)).save(photo)
    write_maps(tmp_path / "short", range(1))
    return {
        "no command": (["fly"], "No such command 'fly'"),
        "no source": (["encode", "-o", none, *camvid], "Missing argument"),
        "no label space": (["encode", maps, "-o", none], "Missing option '--labels-as'"),
        "unknown option": (["query", db, maps, "--topp", 3], "No such option"),
        "option out of range": (["query", db, maps, "--top", 0], "Invalid value for '--top'"),
        "unknown label space": (
            ["encode", maps, "-o", none, "--labels-as", "camvid"],
            "unknown label space 'camvid'; wanted one of",
        ),
        "unknown preset": (
            ["encode", maps, "-o", none, *camvid, "--preset", "fast"],
            "preset must be one of paper, default, got 'fast'",
        ),
        "missing source": (["encode", none, "-o", none, *camvid], "none does not exist"),
        "empty folder": (
            ["encode", tmp_path / "folder", "-o", none, *camvid],
            "folder holds no label maps",
        ),
        "output is a file": (["encode", maps, "-o", tmp_path / "file", *camvid], "no database"),
        "output below a file": (["encode", maps, "-o", tmp_path / "file" / "db", *camvid], "file"),
        "start beyond the end": (
            ["encode", maps, "-o", none, *camvid, "--start", 99],
            "no sequence has a frame 99; the longest has 6 frames",
        ),
        "not a database": (
            ["query", tmp_path / "folder", maps],
            "folder is not a database: it has no manifest.json",
        ),
        "two tolerances": (
            ["evaluate", db, maps, "--tolerance-frames", 1, "--tolerance-metres", 5],
            "wanted one of --ground-truth, --tolerance-metres and --tolerance-frames, got 2",
        ),
        "no tolerance": (["evaluate", db, maps], "got 0 of them"),
        "degrees alone": (
            ["evaluate", db, maps, "--tolerance-frames", 1, "--tolerance-degrees", 5],
            "--tolerance-degrees wants --tolerance-metres beside it",
        ),
        "unknown convention": (
            ["evaluate", db, maps, "--tolerance-frames", 1, "--convention", "sklearn"],
            "'sklearn' is not one of 'exact', 'vpr-bench', 'vpr-tutorial'",
        ),
        "unequal length": (
            ["evaluate", db, tmp_path / "short", "--tolerance-frames", 1],
            "one length, got 1 query frames and 6 reference frames",
        ),
        "no poses": (["evaluate", db, maps, "--tolerance-metres", 5], "have no pose"),
        "ground truth of others": (
            ["evaluate", db, maps, "--ground-truth", tmp_path / "truth.json"],
            "has an entry for none of the 6 queries, as monday/000",
        ),
        "no ground truth": (["evaluate", db, maps, "--ground-truth", none], "cannot read"),
        "show a photo": (
            ["show", photo, "-o", tmp_path / "x.png", *camvid],
            "is not in label space camvid-11; is this a photo",
        ),
        "show to no format": (
            ["show", maps / "001.png", "-o", tmp_path / "x.docx", *camvid],
            "docx",
        ),
        "show to nowhere": (
            ["show", maps / "001.png", "-o", none / "x.png", *camvid],
            "No such file or directory",
        ),
    }


@pytest.mark.parametrize(
    "case",
    [
        "no command",
        "no source",
        "no label space",
        "unknown option",
        "option out of range",
        "unknown label space",
        "unknown preset",
        "missing source",
        "empty folder",
        "output is a file",
        "output below a file",
        "not a database",
        "start beyond the end",
        "two tolerances",
        "no tolerance",
        "degrees alone",
        "unknown convention",
        "unequal length",
        "no poses",
        "ground truth of others",
        "no ground truth",
        "show a photo",
        "show to no format",
        "show to nowhere",
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(ssrvlad, database, tmp_path, case):
    (tmp_path / "truth.json").write_text('{"tuesday/000": []}')
    arguments, message = bad_uses(tmp_path)[case]
    code, _, err = ssrvlad(*arguments)
    assert code == 2
    assert message in err[-1]
    assert err[-1].startswith("ssrvlad: ")
    assert not [line for line in err if "Traceback" in line]
    assert len(err) == 1
    assert not (tmp_path / "none").exists()


def test_all_queries_refused(ssrvlad, database, tmp_path):
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.png").write_text("no image")
    code, out, err = ssrvlad(
        "evaluate", database, tmp_path / "bad", "--tolerance-frames", 1, "--json"
    )
    assert code == 3
    assert json.loads(out)["recall_at"]["1"] is None
    assert len(err) == 1


def test_a_database_without_frames(ssrvlad, database, maps, tmp_path):
    db = tmp_path / "bare.ssrdb"
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.png").write_text("no image")
    ssrvlad("encode", tmp_path / "bad", "-o", db, "--labels-as", "camvid-11")
    code, _, err = ssrvlad("query", db, maps)
    assert (code, err) == (2, [f"ssrvlad: {db} holds no frames yet"])


def test_damage_is_named(ssrvlad, database, maps):
    part = next(database.glob("part-*.parquet"))
    shutil.move(part, database / "lost")
    code, _, err = ssrvlad("query", database, maps)
    assert code == 2
    assert f"{part} is missing or damaged" in err[-1]
    assert len(err) == 1


def test_a_label_map_of_one_colour_is_no_problem(ssrvlad, maps, tmp_path):
    for ids in (ROAD, SKY):
        Image.fromarray(np.full((1, 1), ids, np.uint8)).save(maps / f"one{ids}.png")
    assert ssrvlad("encode", maps, "-o", tmp_path / "db", "--labels-as", "camvid-11")[0] == 0


# ---- images and a segmenter


@pytest.fixture
def photos(maps, tmp_path, monkeypatch):
    """``photos/monday``, the world of ``maps`` as a camera sees it, and ``net.yaml``, which labels
    it; the user's cache is ``cache``."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_graph(tmp_path / "net.onnx")
    (tmp_path / "net.yaml").write_text("network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n")
    folder = tmp_path / "photos" / "monday"
    folder.mkdir(parents=True)
    for path in maps.iterdir():
        Image.fromarray(photo(np.asarray(Image.open(path)))).save(folder / path.name)
    return folder


def test_images_and_a_segmenter_give_what_label_maps_give(ssrvlad, database, photos, tmp_path):
    db, segmenter = tmp_path / "photos.ssrdb", ["--segmenter", tmp_path / "net.yaml"]
    command = ["encode", photos, "-o", db, "--labels-as", "camvid-11", *segmenter]
    code, out, err = ssrvlad(*command)
    assert (code, err) == (0, [])
    assert "6 frames encoded (0 of them empty), 0 already there, 0 refused" in out
    by_labels, by_images = Database.open(database).load(), Database.open(db).load()
    assert by_images.frames == by_labels.frames
    assert torch.equal(by_images.descriptors, by_labels.descriptors)
    assert "0 frames encoded (0 of them empty), 6 already there" in ssrvlad(*command)[1]

    code, out, _ = ssrvlad("query", database, photos, "--temporal", 0, "--top", 1, *segmenter)
    assert code == 0
    assert out.splitlines() == [f"monday/{n:03d}: monday/{n:03d} 1.0000" for n in range(6)]

    options = ["--tolerance-frames", 1, "--json"]
    code, out, _ = ssrvlad("evaluate", database, photos, *options, *segmenter)
    assert code == 0
    assert out == ssrvlad("evaluate", db, photos.parents[1] / "monday", *options)[1]


def test_label_maps_are_kept_in_the_cache_of_the_user_or_where_told(ssrvlad, photos, tmp_path):
    command = ["encode", photos, "--labels-as", "camvid-11", "--segmenter", tmp_path / "net.yaml"]
    assert ssrvlad(*command, "-o", tmp_path / "a")[0] == 0
    kept = list((tmp_path / "cache" / "ssrvlad").rglob("*.png"))
    assert len(kept) == 6
    written = {path: path.stat().st_mtime_ns for path in kept}
    assert ssrvlad(*command, "-o", tmp_path / "b", "--preset", "paper")[0] == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == written
    elsewhere = tmp_path / "elsewhere"
    assert ssrvlad(*command, "-o", tmp_path / "c", "--segmenter-cache", elsewhere)[0] == 0
    assert len(list(elsewhere.rglob("*.png"))) == 6


def test_an_image_that_cannot_be_read_is_listed_and_the_rest_lands(ssrvlad, photos, tmp_path):
    whole = (photos / "002.png").read_bytes()
    (photos / "002.png").write_bytes(whole[: len(whole) // 2])
    code, out, err = ssrvlad(
        "encode", photos, "-o", tmp_path / "db", "--labels-as", "camvid-11",
        "--segmenter", tmp_path / "net.yaml",
    )  # fmt: skip
    assert code == 3
    assert "5 frames encoded (0 of them empty), 0 already there, 1 refused" in out
    assert len(err) == 1
    assert f"refused monday/002: {photos}/002.png: " in err[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--segmenter", "none.onnx"], "none.onnx does not exist or is no file"),
        (["--segmenter", "none.yaml"], "cannot read the settings none.yaml: No such file"),
        (["--segmenter", "monday/000.png"], "monday/000.png is no ONNX graph that can be run"),
        (
            ["--segmenter", "net.onnx", "--labels-as", "synthia"],
            "net.onnx: no output fits label space synthia: got found (?, 12, ?, ?)",
        ),
        (["--segmenter-cache", "cache"], "--segmenter-cache wants a --segmenter"),
    ],
)
def test_wrong_use_of_a_segmenter(ssrvlad, photos, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    arguments = ["encode", photos, "-o", "db", "--labels-as", "camvid-11", *options]
    code, _, err = ssrvlad(*arguments)
    assert (code, len(err)) == (2, 1)
    assert message in err[0]
    assert not Path("db").exists()


def test_a_folder_without_images_is_refused(ssrvlad, photos, tmp_path):
    (tmp_path / "folder").mkdir()
    code, _, err = ssrvlad(
        "encode", tmp_path / "folder", "-o", tmp_path / "none", "--labels-as", "camvid-11",
        "--segmenter", tmp_path / "net.onnx",
    )  # fmt: skip
    assert (code, len(err)) == (2, 1)
    assert "folder holds no images; wanted .jpg" in err[0]
    assert not (tmp_path / "none").exists()
