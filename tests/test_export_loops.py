"""Loops without torch: the command line's answers, line by line."""

import os
import subprocess
from functools import partial
from pathlib import Path

import loops_onnx
import pytest
from helpers import street, without
from loop_streams import assert_same_answers, objects, write_drive
from PIL import Image
from test_run_onnx import DEPENDENCIES

SETTINGS = ("--exclude", 5, "--threshold", 0.7)


@pytest.fixture
def run(main_of):
    return partial(main_of, loops_onnx.main, "loops_onnx.py")


@pytest.fixture
def drive(tmp_path):
    return write_drive(tmp_path / "drive")


def test_without_torch_it_says_what_the_command_line_says(ssrvlad, head, drive):
    """Name by name, the next only once the last is answered."""
    expected = objects(
        ssrvlad("loops", drive, "--labels-as", "camvid-11", *SETTINGS, "--no-sweep", "--json")[1]
    )
    assert sum(line["reason"] == "accepted" for line in expected) > 3
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = without(DEPENDENCIES, Path(loops_onnx.__file__), head, "-", *SETTINGS)
    with subprocess.Popen(command, **pipes) as process:
        lines = []
        for path in sorted(drive.iterdir()):
            process.stdin.write(os.fsencode(path) + b"\n")
            process.stdin.flush()
            lines.append(process.stdout.readline())
        out, err = process.communicate()
    assert (process.returncode, out, err) == (0, b"", b"")
    assert_same_answers(objects(b"".join(lines)), expected)


def test_a_bad_frame_is_refused_and_the_stream_goes_on(head, drive, run):
    (drive / "07.png").write_text("no picture")
    Image.fromarray(street(0) + 100).save(drive / "09.png")
    code, out, err = run(head, drive, *SETTINGS)
    assert (code, len(objects(out)), len(err)) == (3, 52, 3)
    assert err[0].startswith(f"{drive / '07.png'}: ")
    assert err[1].endswith("pixels have an id outside label space camvid-11")
    assert err[2] == "skipped 2 of 54 frames"


def test_wrong_use_is_one_line(head, drive, tmp_path, run):
    code, out, (error,) = run(tmp_path / "none.onnx", drive)
    assert (code, out) == (2, "")
    assert error.startswith("loops_onnx: ")
    (tmp_path / "empty").mkdir()
    code, _, (error,) = run(head, tmp_path / "empty")
    problem = "holds no label maps; expected .png, .npy, .tif, .tiff, .bmp files"
    assert (code, error) == (2, f"loops_onnx: {tmp_path / 'empty'} {problem}")
    code, _, (error,) = run(head, "-", drive)
    assert (code, error) == (2, "loops_onnx: - does not exist and matches no file")
    for wrong in (("--exclude", -1), ("--threshold", 2)):
        code, _, errors = run(head, drive, *wrong)
        assert code == 2
        assert errors[-1].endswith("expected --exclude from 0 and --threshold from 0 to 1")
