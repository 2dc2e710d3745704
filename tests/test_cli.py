"""The command line as a user meets it: output, exit codes, one-line errors."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from drawings import ROAD, SKY, VOID, blobs
from PIL import Image

from ssrvlad_torch import cli

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
        "no poses": (["evaluate", db, maps, "--tolerance-metres", 5], "have no pose"),
        "ground truth of others": (
            ["evaluate", db, maps, "--ground-truth", tmp_path / "truth.json"],
            "has no entry for query monday/000",
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
