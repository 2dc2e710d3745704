"""Hostile files for every reader: an error in one line, and its exit code.

A table holds functions that write a file, and text of the error message. ``maps`` is a folder of
label maps, ``town.ssrdb`` a database of them.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import bad_files as bad
import pytest
from helpers import write_maps, write_photos

SPACE = "name: own\nsource: here\nclasses:\n  - {id: 0, name: sky, category: sky"
Make = Callable[[Path], object]

SKIPPED = 3


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Good files that commands need, written once."""
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture
def here(tmp_path, monkeypatch, ssrvlad, good):
    monkeypatch.chdir(tmp_path)
    if not (good / "town.ssrdb").exists():
        write_maps(good / "maps", range(3))
        write_photos(good / "photos", range(2))
        database = ("encode", good / "maps", "-o", good / "town.ssrdb", "--labels-as", "camvid-11")
        assert ssrvlad(*database)[0] == 0
        assert ssrvlad("export", "-o", good / "head.onnx", "--labels-as", "camvid-11")[0] == 0
    for name in ("maps", "photos", "town.ssrdb"):
        shutil.copytree(good / name, tmp_path / name)
    shutil.copy(good / "head.onnx", tmp_path)
    return tmp_path


def one_line(ssrvlad, command: str, message: str) -> str:
    code, _, err = ssrvlad(*command.split())
    assert (code, len(err)) == (2, 1), err
    assert message in err[0]
    assert err[0].isprintable()
    return err[0]


LABEL_MAPS: list[tuple[Make, str]] = [
    (lambda p: bad.png(p / "x.png"), "has 13000 x 13000 pixels; expected at most 64000000"),
    (lambda p: bad.array(p / "x.npy", (4000, 5000), b"1"), "has 1 bytes for an array"),
    (lambda p: bad.text(p / "x.png", "no picture"), "cannot identify the image"),
    (lambda p: (p / "x.png").symlink_to("nowhere"), "No such file"),
]


@pytest.mark.parametrize(("make", "message"), LABEL_MAPS)
def test_a_hostile_label_map_is_skipped_in_one_line(here, ssrvlad, make, message):
    bad_folder = here / "bad"
    bad_folder.mkdir()
    make(bad_folder)
    code, _, err = ssrvlad(
        *["encode", "maps", "bad", "-o", "new.ssrdb", "--labels-as", "camvid-11"]
    )
    assert (code, len(err)) == (SKIPPED, 1), err
    assert message in err[0]
    assert "bad/x" in err[0]


@pytest.mark.parametrize("limit", ["5", "many"])
def test_a_wrong_limit_of_the_environment_is_named(here, ssrvlad, monkeypatch, limit):
    monkeypatch.setenv("SSRVLAD_PIXEL_LIMIT", limit)
    one_line(ssrvlad, "show maps/000.png -o fig.png --labels-as camvid-11", "SSRVLAD_PIXEL_LIMIT")
    monkeypatch.setenv("SSRVLAD_FILE_LIMIT", limit)
    one_line(ssrvlad, "show maps/000.png -o fig.png --labels-as camvid-11", "SSRVLAD_FILE_LIMIT")


YAML: list[tuple[str, str]] = [
    (bad.ALIASES, "an alias in line 2"),
    (bad.NESTED, "more than 20 levels in line 1"),
    ("a: !!python/object/apply:os.system [ls]", "not plain YAML"),
    ("\0", "not plain YAML"),
    ("x" * (2 << 20), "has 2097152 bytes; expected at most 1048576"),
]


SIZES = ["[]", "[30000, 30000]", "[0, 4]", "[a, b]", "[1.5, 3]"]
NO_FILES: list[tuple[Make, str]] = [
    (lambda p: bad.pipe(p / "own.yaml"), "is a pipe; expected a file"),
    (lambda p: bad.endless(p / "own.yaml"), "is a device; expected a file"),
    (lambda p: (p / "own.yaml").mkdir(), "is a folder; expected a file"),
]
TRUTHS: list[tuple[str, Make, str]] = [
    ("bad.json", lambda p: bad.text(p, bad.NESTED), "nested too deeply"),
    ("bad.npy", lambda p: bad.array(p, (1 << 20, 1 << 20)), "has 0 bytes for an array"),
    ("bad.json", bad.pipe, "is a pipe"),
    ("bad.csv", bad.endless, "is a device"),
    ("bad.csv", lambda p: bad.text(p, "query,reference\n\0,b\n"), "bad.csv"),
]


def yaml(content: str) -> Make:
    return lambda folder: bad.text(folder / "own.yaml", content)


LABELS, ENCODE = "labels own.yaml", "encode maps -o new.ssrdb --labels-as own.yaml"
SEGMENT = "encode photos -o new.ssrdb --labels-as camvid-11 --segmenter own.yaml"
REFUSED = [
    *((LABELS, yaml(content), message) for content, message in YAML),
    *((SEGMENT, yaml(content), message) for content, message in YAML),
    *((SEGMENT, yaml(f"network: net.onnx\nsize: {size}\n"), "own.yaml: ") for size in SIZES),
    *((command, make, message) for command in (LABELS, ENCODE) for make, message in NO_FILES),
    *(
        (
            f"evaluate town.ssrdb maps --ground-truth {name}",
            lambda p, n=name, m=make: m(p / n),
            message,
        )
        for name, make, message in TRUTHS
    ),
]


@pytest.mark.parametrize(("command", "make", "message"), REFUSED)
def test_a_hostile_file_is_one_line_that_names_it(here, ssrvlad, command, make, message):
    make(here)
    assert command.split()[-1] in one_line(ssrvlad, command, message)


OUTPUTS = [
    "export --labels-as camvid-11 -o",
    "show maps/000.png --labels-as camvid-11 -o",
    "db export town.ssrdb --format npy -o",
    "evaluate town.ssrdb maps --report",
]


@pytest.mark.parametrize("command", OUTPUTS)
def test_outputs_must_be_regular_files(here, ssrvlad, command):
    (here / "folder.png").mkdir()
    bad.pipe(here / "pipe.png")
    (here / "device.png").symlink_to(os.devnull)
    for name, message in (
        ("folder.png", "cannot write folder.png: it is a folder"),
        ("pipe.png", "cannot write pipe.png: it is not a regular file"),
        ("device.png", "cannot write device.png: it is not a regular file"),
        ("none/x.png", "cannot write none/x.png: there is no folder none"),
    ):
        one_line(ssrvlad, f"{command} {name}", message)
    assert Path(os.devnull).is_char_device()
    assert not [name for name in here.iterdir() if name.name.startswith(".")]


def test_a_link_stays_a_link(here, ssrvlad):
    (here / "shown.png").symlink_to("target.png")
    assert ssrvlad(*["show", "maps/000.png", "--labels-as", "camvid-11", "-o", "shown.png"])[0] == 0
    assert (here / "shown.png").is_symlink()
    assert (here / "target.png").stat().st_size > 0


def test_names_with_control_characters_stay_on_their_line(here, ssrvlad):
    for name in ("new\nline", "bell\a", "\x1b[31mred"):
        shutil.copy(here / "maps" / "000.png", here / "maps" / f"{name}.png")
    assert ssrvlad(*["encode", "maps", "-o", "odd.ssrdb", "--labels-as", "camvid-11"])[0] == 0
    code, out, _ = ssrvlad(*["query", "odd.ssrdb", "maps"])
    lines = out.splitlines()
    assert code == 0
    assert sum(line.startswith("maps/") for line in lines) == 6
    assert all(line.isprintable() for line in lines)
