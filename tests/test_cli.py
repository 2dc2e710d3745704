"""The command line as a user meets it: help, exit codes, one-line errors, Ctrl-C."""

import errno
import io
import json
import os
import signal
import subprocess
import sys
import time
from unittest.mock import Mock

import numpy as np
import pytest
from drawings import SPACE
from helpers import assert_no_reader_is_no_error, outcome, write_maps
from networks import photo, write_settings
from networks import write_photos as write_streets
from PIL import Image

from ssrvlad_torch import __version__
from ssrvlad_torch.cli import main as cli
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


def test_another_pipe_that_breaks_is_an_error(refusal, maps, tmp_path, monkeypatch):
    broken = BrokenPipeError(errno.EPIPE, "Broken pipe")
    monkeypatch.setattr("ssrvlad_torch.map.Map.open", Mock(side_effect=broken))
    assert refusal("encode", maps, "-o", tmp_path / "db").endswith(": [Errno 32] Broken pipe")


@pytest.mark.parametrize(
    ("module", "at_import", "made", "line"),
    [
        ("ends_at_import", "sys.exit(2)", "0", "'ends_at_import:make': it calls sys.exit(2)"),
        ("ends_when_made", "", "sys.exit('no weights')", "it calls sys.exit('no weights')"),
        ("ends_at_work", "", "Ends(3, 3, 1)", "a network or a library calls sys.exit(None)"),
    ],
)
def test_a_network_that_ends_the_program_is_an_error(
    ssrvlad, tmp_path, monkeypatch, module, at_import, made, line
):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / f"{module}.py").write_text(
        "import sys\nfrom torch import nn\nclass Ends(nn.Conv2d):\n"
        f"    def forward(self, images): sys.exit()\n{at_import}\ndef make(): return {made}\n"
    )
    photos = write_streets(tmp_path / "photos", range(1), (60, 80))
    network = ("--segmenter", f"{module}:make", "--labels-as", SPACE)
    code, out, err = ssrvlad("encode", photos, "-o", tmp_path / "db", *network)
    assert (code, out) == (2, "") and line in err[-1]
    assert all(each.startswith("ssrvlad: ") for each in err), err


def test_sigterm_while_a_network_is_imported_is_no_fault_of_it(ssrvlad, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "is_ended.py").write_text("import sys\nsys.exit(143)\n")
    code, out, err = ssrvlad("labels", "is_ended:make")
    assert (code, out, err) == (143, "", ["ssrvlad: terminated"])


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


def test_an_error_of_the_system_is_the_file_and_what_the_system_says():
    error = PermissionError(errno.EACCES, "Permission denied", "frames/a.png")
    assert cli._sentence(error) == "frames/a.png: Permission denied"


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
    code, _, err = outcome(*command, "--labels-as", "camvid-11")
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
    words = ("encode", "drive", "-o", "db", "--labels-as", "camvid-11")
    command = [sys.executable, "-c", TERMINAL, *words]
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
    *_, told, last = err.splitlines(keepends=True)
    assert (process.returncode, last) == end
    stored = len(Database.open(tmp_path / "db"))
    assert stored < 2000 and f"db holds {stored} frames; the same command goes on" in told


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
