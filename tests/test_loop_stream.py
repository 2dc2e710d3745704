"""Loops over files, in Python and as a user of ``ssrvlad loops`` meets them."""

import io
import json
import os
import re
import subprocess
import sys

import pytest
from helpers import street, write_street
from loop_streams import SEEDS, objects, write_drive
from PIL import Image

from ssrvlad_torch import Database
from ssrvlad_torch.loops.detector import LoopDetector

SETTINGS = ("--exclude", 5, "--no-sweep")
LOOPS = {f"drive/{n}": f"drive/{n - 30}" for n in range(42, 54)}
"""The filter is sure after two of the fourteen."""


@pytest.fixture
def drive(tmp_path):
    """A folder of label maps with poses."""
    folder = write_drive(tmp_path / "drive")
    lines = [f"drive/{n:02d},{10 * seed},0,0" for n, seed in enumerate(SEEDS)]
    (folder / "poses.csv").write_text("\n".join(["frame,x,y,heading", *lines]) + "\n")
    return folder


@pytest.fixture
def loops(ssrvlad, monkeypatch):
    """Runs the command; returns exit code, stdout and the lines of stderr."""

    def run(*arguments, stdin=b"", settings=SETTINGS):
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(stdin)))
        return ssrvlad("loops", *arguments, "--labels-as", "camvid-11", *settings)

    return run


def accepted(lines):
    return {line["frame"]: line["candidate"] for line in lines if line["reason"] == "accepted"}


def test_a_line_of_json_for_every_frame(loops, drive):
    code, out, err = loops(drive, "--json")
    lines = objects(out)
    assert (code, err) == (0, [])
    assert [line["frame"] for line in lines] == [f"drive/{n:02d}" for n in range(54)]
    assert [*lines[0].values()] == ["drive/00", "no_candidate", None, None, None, None, []]
    assert {line["reason"] for line in lines[1:7]} == {"too_recent"}
    assert accepted(lines) == LOOPS
    assert lines[-1]["score"] == pytest.approx(1)


def test_text_shows_the_loops_and_counts_the_rest(loops, drive, monkeypatch):
    code, out, _ = loops(drive)
    lines = out.splitlines()
    assert (code, len(lines)) == (0, 14)
    for line, (frame, there) in zip(lines, LOOPS.items(), strict=False):
        assert re.fullmatch(
            rf"{frame}: {there} \(confidence \d\.\d\d, [+-]\d\.\d m ahead\)", line
        ), line
    assert lines[12].startswith("54 frames: 12 accepted, ")
    assert lines[13] == "steps: standardised, anchors 0, no temporal sum, followed online"
    assert "anchors -4, 0, 4, no temporal sum" in loops(drive / "00.png", settings=())[1]
    monkeypatch.setattr(LoopDetector, "scans", True)
    assert "online, all frames by a part of their signs" in loops(drive / "00.png")[1]


def test_precision_and_recall_by_poses(loops, drive):
    _, out, _ = loops(drive, "--tolerance-metres", 5)
    precision, suggestion = out.splitlines()[-2:]
    right = "precision 1.000 (12 of 12 loops are right), recall 0.857 (12 of 14 revisits)"
    assert precision == right
    accepts = r"1\d of \d+ accepted, none wrong \(precision at least 7\d %\)"
    assert re.fullmatch(rf"Suggested threshold 0\.\d+: {accepts}", suggestion)
    _, out, _ = loops(drive, "--tolerance-metres", 5, "--json")
    *frames, summary = objects(out)
    assert len(frames) == 54
    assert (summary["frames"], summary["reasons"]["accepted"], summary["precision"]) == (54, 12, 1)
    assert (summary["revisits"], summary["right"], summary["steps"]["sweep"]) == (14, 12, [])
    assert summary["recall"] == pytest.approx(12 / 14)
    assert summary["suggested"]["accepted"] >= 12
    lowest = min(line["confidence"] for line in frames if line["reason"] == "accepted")
    assert lowest - 0.01 < summary["suggested"]["threshold"] < lowest
    text = (drive / "poses.csv").read_text().replace("drive/50,200", "drive/50,290")
    (drive / "poses.csv").write_text(text)
    _, out, _ = loops(drive, "--tolerance-metres", 5, "--json")
    summary = objects(out)[-1]
    assert (summary["accepted"], summary["right"]) == (12, 11)
    assert summary["suggested"]["precision"] <= 1


def test_without_a_loop_the_likeliest_pair_is_told(loops, drive):
    _, out, _ = loops(drive, settings=(*SETTINGS, "--threshold", 1))
    lines = objects(loops(drive, "--json")[1])
    best = max(lines, key=lambda line: line["confidence"] or 0)
    summary = f"no loop: the likeliest is {best['frame']}: {best['candidate']} with confidence "
    assert out.splitlines()[-2] == f"{summary}{best['confidence']:.2f}, --threshold 1"
    assert out.splitlines()[-1].endswith("a street driven the other way is never found")
    (drive / "50.png").unlink()
    _, out, _ = loops(*(drive / f"{n:02d}.png" for n in range(12)))
    assert "with confidence 0.0" in out and ", more likely wrong than right, " in out
    _, out, _ = loops(drive, settings=())
    assert "no loop: no frame comes more than --exclude 50 frames after another" in out
    assert "no loop" not in loops(drive)[1]


def test_where_most_frames_are_too_recent_the_hint_names_exclude(loops, tmp_path):
    for number in range(60):
        write_street(tmp_path / f"{number:02d}.png", number)
    _, out, _ = loops(tmp_path, settings=("--no-sweep",))
    assert out.splitlines()[-1].startswith("51 of 60 frames are too_recent: the --exclude 50 ")


def test_a_picture_that_cannot_be_is_refused_before_the_first_frame(loops, drive, monkeypatch):
    other = loops(drive, "--picture", drive / "loops.xyz")
    assert other[2][0].startswith(f"ssrvlad: {drive / 'loops.xyz'}: a picture is one of ")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    without = loops(drive, "--picture", drive / "loops.png")
    assert without[2][0].endswith("pictures need: pip install ssrvlad-torch[eval]")
    assert [(code, out, len(err)) for code, out, err in (other, without)] == [(2, "", 1)] * 2


def test_names_on_stdin_are_the_same_stream(loops, drive):
    names = "".join(f"{path}\n" for path in sorted(drive.glob("*.png")))
    by_folder = loops(drive, "--json", "--tolerance-metres", 5)
    assert loops("-", "--json", "--tolerance-metres", 5, stdin=names.encode()) == by_folder
    spaced = names.replace("\n", "\r\n\n").encode()
    assert loops("-", "--json", "--tolerance-metres", 5, stdin=spaced) == by_folder


def test_a_bad_frame_is_skipped_and_the_stream_goes_on(loops, drive):
    """Damaged, no picture, an unknown id, missing, a folder, and one that was there before."""
    paths = sorted(map(str, drive.glob("*.png")))
    (drive / "damaged.png").write_bytes((drive / "03.png").read_bytes()[:60])
    (drive / "text.png").write_text("no picture")
    Image.fromarray(street(0) + 100).save(drive / "strange.png")
    bad = [f"{drive}/{name}" for name in ("damaged.png", "text.png", "strange.png", "gone.png")]
    names = [*paths[:8], *bad, str(drive), paths[0], *paths[8:]]
    code, out, err = loops("-", "--json", stdin="\n".join(names).encode())
    assert code == 3, err
    assert (accepted(objects(out)), len(objects(out)), len(err)) == (LOOPS, 54, 6)
    skipped = [line.split(": ")[1] for line in err]
    names = ("damaged", "text", "strange", "gone")
    assert skipped[:4] == [f"skipped drive/{name}" for name in names]
    assert skipped[5] == "skipped drive/00" and "was there before" in err[5]


def test_each_frame_of_a_live_pipe_is_answered_at_once(drive):
    """The next name is written only once the answer to the last one is read. The last name is no
    text, and its file is not there."""
    command = [sys.executable, "-m", "ssrvlad_torch", "loops", "-", "--labels-as", "camvid-11"]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen([*command, "--json"], **pipes) as process:
        for path in sorted(drive.glob("*.png"))[:4]:
            process.stdin.write(os.fsencode(path) + b"\n")
            process.stdin.flush()
            assert json.loads(process.stdout.readline())["frame"] == f"drive/{path.stem}"
        out, err = process.communicate(os.fsencode(drive) + b"/\xff.png\n")
    assert (process.returncode, out) == (3, b"")
    assert err.startswith(b"ssrvlad: skipped drive/")
    assert err.count(b"\n") == 1


def test_a_memory_is_gone_on_from(loops, drive, tmp_path):
    """Where the drive was is not kept, so that loops wait for the filter again."""
    memory = tmp_path / "drive.ssrdb"
    last = [*drive.glob("4*.png"), *drive.glob("5*.png")]
    moved = {path: path.rename(path.with_suffix(".later")) for path in last}
    first = objects(loops(drive, "--json", "--memory", memory)[1])
    for path, later in moved.items():
        later.rename(path)
    second = objects(loops(drive, "--json", "--memory", memory, "--tolerance-metres", 5)[1])
    assert [line["frame"] for line in (*first, *second[:-1])] == [
        f"drive/{n:02d}" for n in range(54)
    ]
    assert (second[-1]["frames"], second[-1]["revisits"]) == (14, 14)
    assert set(accepted(second[:-1]).items()) <= set(LOOPS.items())
    assert accepted(second[:-1])["drive/53"] == "drive/23"
    assert loops(drive, "--json", "--memory", memory)[:2] == (0, "")
    known = "all 54 frames are in the memory already\n"
    assert loops(drive, "--memory", memory)[:2] == (0, known)
    stored = Database.open(memory).load()
    assert stored.frames == tuple(f"drive/{n:02d}" for n in range(54))
    assert stored.poses[:, 0].tolist() == [10 * seed for seed in SEEDS]


def test_a_memory_may_be_a_uri(loops, drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert loops(drive, "--memory", f"file://{tmp_path}/memory")[0] == 0
    assert len(Database.open(tmp_path / "memory")) == len(SEEDS)
    assert not (tmp_path / "file:").exists()


def test_a_memory_says_what_ids_mean(ssrvlad, drive, tmp_path):
    memory = tmp_path / "memory.ssrdb"
    missing = "expected the label space of the label maps, --labels-as, or a network for pictures"
    assert missing in ssrvlad("loops", drive, "--memory", memory)[2][0]
    assert ssrvlad("encode", drive, "-o", memory, "--labels-as", "camvid-11")[0] == 0
    code, out, _ = ssrvlad("loops", drive, "--memory", memory, "--sequence", "again")
    assert code == 0 and "frames:" in out


@pytest.mark.parametrize("poses", [True, False])
def test_a_picture_is_drawn(loops, drive, tmp_path, poses):
    if not poses:
        (drive / "poses.csv").unlink()
    picture = tmp_path / "loops.png"
    assert loops(drive, "--picture", picture)[0] == 0
    with Image.open(picture) as image:
        assert image.width == (1100 if poses else 550)


def test_nothing_on_stdin_is_no_error(loops):
    code, out, err = loops("-")
    assert (code, out.splitlines()[0], err) == (0, "0 frames: nothing", [])
    assert "no loop" not in out
