"""The command line as a user meets it: help, exit codes, one-line errors, Ctrl-C."""

import io
import json
import os
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from drawings import SPACE
from helpers import assert_no_reader_is_no_error, outcome, write_maps, write_photos
from networks import photo, write_settings
from networks import write_photos as write_streets
from PIL import Image

from ssrvlad_torch import __version__
from ssrvlad_torch.cli.output import print_table
from ssrvlad_torch.database.database import Database


@pytest.mark.parametrize(
    ("line", "begin", "words"),
    [((), "Usage: ", "encode"), (("--version",), f"ssrvlad {__version__}, ", "the native core (")],
)
def test_without_a_command_it_prints_help_or_the_version(ssrvlad, line, begin, words):
    code, out, err = ssrvlad(*line)
    assert (code, err) == (0, [])
    assert out.startswith(begin) and words in out


def test_a_table_shows_text_as_it_is(capsys):
    """Neither markup of rich nor escape sequences of terminals."""
    print_table(("[red]a",), [["[/b] :car: \x1b[31m\u202e"]])
    out = capsys.readouterr().out
    assert "[red]a" in out and "[/b] :car: \\x1b[31m\\u202e" in out


NO_TORCH = """
import sys
from ssrvlad_torch.cli.main import main
for line in sys.argv[1:]:
    sys.argv[1:] = line.split()
    try: main()
    except SystemExit as end: assert not end.code, line
    assert "torch" not in sys.modules, line
"""


def test_help_and_db_info_need_no_torch(database):
    lines = ["--help", "encode --help", "db info --help", f"db info {database}"]
    code, out, err = outcome(sys.executable, "-c", NO_TORCH, *lines)
    assert (code, err) == (0, [])
    assert "\n".join(out).count("Usage: ") == 3 and "camvid-11" in "\n".join(out)


def test_debug_shows_the_traceback(ssrvlad):
    code, _, err = ssrvlad("query", "none", "none", "--debug")
    assert code == 2
    assert err[0].startswith("Traceback")
    assert err[-1].startswith("ssrvlad: ")


def test_a_closed_pipe_is_no_error(database, maps):
    assert_no_reader_is_no_error(sys.executable, "-m", "ssrvlad_torch", "query", database, maps)


@pytest.mark.parametrize(
    "closed", [(1,), *(pytest.param(n, marks=pytest.mark.slow) for n in ((2,), (0, 1, 2)))]
)
def test_a_closed_stream_is_the_null_device(database, maps, tmp_path, closed):
    """What `ssrvlad ... >&-` does: no traceback, and no line gets into another stream or file."""
    out, err = (tmp_path / name for name in ("out", "err"))
    line = f"{sys.executable} -m ssrvlad_torch query {database} {maps} --top 1 >{out} 2>{err}"
    line += "".join(f" {stream}>&-" for stream in closed)
    assert subprocess.run(line, shell=True, check=False).returncode == 0
    results = [f"monday/{n:03d}: monday/{n:03d}" for n in range(6)]
    lines = [" ".join(line.split()[:2]) for line in out.read_text().splitlines()]
    assert lines == ([] if 1 in closed else results)
    notes = err.read_text().splitlines()
    assert len(notes) == (2 not in closed) and all("Matched as" in line for line in notes)
    assert len(Database.open(database).load()) == 6


CAMVID = "--labels-as camvid-11"
NONE = f"-o none {CAMVID}"
EVALUATE = "evaluate town.ssrdb monday"

WRONG_USES = [
    ("verify none.onnx", "ssrvlad: none.onnx does not exist; expected an ONNX graph"),
    ("fly", "No such command 'fly'"),
    (f"encode {NONE}", "Missing argument"),
    (f"encode '' {NONE}", "the argument after encode is empty; expected a text"),
    (f"encode monday {NONE} --sequence=", "--sequence is empty; expected a text"),
    ("db compact town.ssrdb --keep-days inf", "--keep-days': Input should be less than or"),
    ("fuse none.onnx -o none/p.onnx --labels-as camvid-11", "there is no folder"),
    ("encode monday -o none", "expected the label space of the label maps, --labels-as"),
    ("query town.ssrdb monday --top 0", "'--top': Input should be greater than or equal to 1"),
    (f"encode none {NONE}", "none does not exist"),
    (f"export {NONE} --size 8", "--size 8: expected rows and columns, such as 512x1024"),
    (f"encode jpegs {NONE}", "jpegs holds images and no label maps; name the network"),
    ("city monday", "monday is not empty; expected a new or an empty folder"),
    (f"encode monday {NONE} --start 99", "no sequence has a frame 99; the longest has 6 frames"),
    (
        f"{EVALUATE} --tolerance-frames 1 --tolerance-metres 5",
        "expected one of --ground-truth, --tolerance-metres and --tolerance-frames, got 2",
    ),
    (EVALUATE, "got 0 of them"),
    (
        f"{EVALUATE} --tolerance-frames 1 --tolerance-degrees 5",
        "--tolerance-degrees needs --tolerance-metres",
    ),
    (
        "query town.ssrdb monday --min-confidence nan",
        "'--min-confidence': Input should be less than or",
    ),
    (f"{EVALUATE} --max-wrong 0.1 --min-confidence 0.5", "leave out --min-confidence"),
    (f"show photo.png -o x.png {CAMVID}", "is not in label space camvid-11; is this a photo"),
    (f"show monday -o x.png {CAMVID}", "ssrvlad: monday: expected one frame, got 6"),
]


@pytest.mark.parametrize(("line", "message"), WRONG_USES)
def test_wrong_use_is_one_line_and_exit_code_2(
    refusal, request, maps, tmp_path, monkeypatch, line, message
):
    if "town.ssrdb" in line:
        request.getfixturevalue("database")
    (tmp_path / "folder").mkdir()
    write_photos(tmp_path / "jpegs", range(1), ".jpg")
    (tmp_path / "file").write_text("no folder")
    write_photos(tmp_path, range(1)).joinpath("000.png").rename(tmp_path / "photo.png")
    monkeypatch.chdir(tmp_path)
    refused = refusal(*shlex.split(line))
    assert refused.startswith("ssrvlad: ") and message in refused
    assert not (tmp_path / "none").exists()


TERMINAL = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    "from ssrvlad_torch.cli.main import main; main()"
)
"""The command line as a terminal starts it; what runs in the background ignores SIGINT."""


@pytest.mark.parametrize("module", ["typer", "torch"])
def test_ctrl_c_during_an_import_is_exit_code_130(module):
    program = (
        "import os, signal, sys\n"
        "class Interrupts:\n"
        "    def find_spec(name, path, target=None):\n"
        f"        if name == {module!r}: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupts)\n"
    )
    command = sys.executable, "-c", program + TERMINAL, "export", "-o", "none/head.onnx"
    code, _, err = outcome(*command, *CAMVID.split())
    assert (code, err) == (130, ["ssrvlad: interrupted"])


@pytest.mark.parametrize(
    ("segmenter", "number", "end"),
    [
        ((), signal.SIGTERM, (143, "ssrvlad: terminated\n")),
        (("--segmenter", "net.yaml"), signal.SIGINT, (130, "ssrvlad: interrupted\n")),
    ],
)
def test_a_signal_ends_a_run_and_done_frames_are_stored(tmp_path, segmenter, number, end):
    """The frames that are done land; a run afterwards goes on from there."""
    maps = write_maps(tmp_path / "maps", range(1))
    write_settings(tmp_path)
    (tmp_path / "drive").mkdir()
    first = tmp_path / "first.png"
    labels = np.asarray(Image.open(maps / "000.png").resize((320, 240), Image.Resampling.NEAREST))
    Image.fromarray(photo(labels) if segmenter else labels).save(first)
    for frame in range(2000):
        (tmp_path / "drive" / f"{frame}.png").symlink_to(first)
    command = [sys.executable, "-c", TERMINAL, "encode", "drive", "-o", "db", *CAMVID.split()]
    with subprocess.Popen(
        [*command, *segmenter],
        cwd=tmp_path,
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        # a picture is labelled, or the second version holds the origin of label maps
        begun, least = ("cache/ssrvlad/*/*/*.npz", 1) if segmenter else ("db/_versions/*", 2)
        while len([*tmp_path.glob(begun)]) < least:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        time.sleep(0.5)
        process.send_signal(number)
        _, err = process.communicate()
    assert (process.returncode, err.splitlines(keepends=True)[-1]) == end
    assert len(Database.open(tmp_path / "db")) < 2000


def test_only_results_are_on_stdout_whatever_a_network_prints(ssrvlad, tmp_path, monkeypatch):
    """With --json each line of stdout is an object, though the network prints where it is built
    and where it labels."""
    (tmp_path / "loud.py").write_text(
        "from networks import Street\n"
        "class Loud(Street):\n"
        "    def forward(self, images):\n"
        "        print('labelling')\n"
        "        return super().forward(images)\n"
        "def loud():\n"
        "    print('built')\n"
        "    return Loud().eval()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    photos = write_streets(tmp_path / "photos", range(5), (64, 96))
    (tmp_path / "truth.json").write_text(json.dumps({"photos/1": ["photos/1"]}))
    names = "".join(f"{photos / name}.png\n" for name in "123")
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(names.encode())))
    settings = tmp_path / "net.yaml"
    settings.write_text(f"network: loud:loud\nmean: [0, 0, 0]\nlabels_as: {SPACE}\n")
    truth = ("--ground-truth", tmp_path / "truth.json")
    for number, command in enumerate([
        ("labels", settings),
        ("encode", photos, "-o", tmp_path / "town"),
        ("query", tmp_path / "town", photos),
        ("locate", photos / "1.png", "--in", tmp_path / "town"),
        ("evaluate", tmp_path / "town", photos, *truth),
        ("loops", photos),
        ("loops", "-"),
    ]):  # fmt: skip
        cache = ("--segmenter-cache", tmp_path / f"cache {number}")
        network = ("--segmenter", settings, *cache) if number else ()
        code, out, err = ssrvlad(*command, *network, "--json")
        assert code == 0, err
        assert out and all(isinstance(json.loads(line), dict) for line in out.splitlines()), command
        assert {"built", "labelling"} <= {*err}, command
