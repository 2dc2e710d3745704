"""`ssrvlad encode`: label maps, or images and a segmenter, into a database."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from drawings import VOID
from helpers import write_image, write_maps
from networks import photo, write_settings
from PIL import Image

from ssrvlad_torch.cli import output
from ssrvlad_torch.database import engine
from ssrvlad_torch.database.database import Database


def uniform(folder, ids):
    """Label maps of one id each."""
    for n, label in enumerate(ids):
        Image.fromarray(np.full((24, 32), label, np.uint8)).save(folder / f"{n:03d}.png")


def test_the_preset_of_a_database_is_used_again(ssrvlad, encode, refusal, maps, tmp_path):
    db = tmp_path / "paper.ssrdb"
    encode(maps, "-o", db, "--preset", "paper")
    write_maps(maps, range(6, 7))
    assert encode(maps, "-o", db)[0] == 0
    assert json.loads(ssrvlad("db", "info", db, "--json")[1])["preset"] == "paper"
    line = refusal("encode", maps, "-o", db, "--labels-as", "camvid-11", "--preset", "default")
    assert "working_size None there and 120 here" in line


def test_names_do_not_depend_on_the_locale(encode, maps, tmp_path):
    folder = maps.rename(tmp_path / "straße")
    plain = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0"}
    command = [folder, "-o", tmp_path / "db", "--labels-as", "camvid-11"]
    module = [sys.executable, "-m", "ssrvlad_torch", "encode"]
    subprocess.run([*module, *command], env=plain, check=True)
    assert "6 already there" in encode(*command)[1]
    frames = Database.open(tmp_path / "db").load().frames
    assert frames == tuple(f"straße/{n:03d}" for n in range(6))
    code = (
        "import sys; from ssrvlad_torch.datasets.label_files import find_label_files as find;"
        "find(sys.argv[1:])"
    )
    refused = subprocess.run(
        [sys.executable, "-c", code, folder], env=plain, capture_output=True, check=False
    )
    assert b"are read as ASCII here, got '" in refused.stderr


def test_a_wrong_label_space_is_one_note_and_skips_are_cut_short(encode, maps, tmp_path):
    uniform(maps, [77] * 25)
    code, _, err = encode(maps, "-o", tmp_path / "db")
    assert code == 2 and len(err) == 22
    assert "no frame could be described: is --labels-as the label space" in err[0]
    assert err[-1] == "ssrvlad: skipped 5 more"


def test_a_label_map_that_is_mostly_void_is_noted(ssrvlad, maps, tmp_path):
    uniform(maps, [0, 1])
    command = ("encode", maps, "-o", tmp_path / "db", "--labels-as")
    _, _, err = ssrvlad(*command, "cityscapes-ids")  # trainIds 0 and 1 are road and sidewalk
    assert f"{maps / '000.png'}: 100% is void in cityscapes-ids; is --labels-as right?" in err[0]
    assert not ssrvlad(*command, "cityscapes-trainids")[2], "all frames were encoded anew"


def test_other_label_spaces_of_the_database_are_noted(ssrvlad, maps, tmp_path):
    other = write_maps(tmp_path / "other", range(2))
    base = ("encode", "-o", tmp_path / "db", "--labels-as")
    ssrvlad(*base, "camvid-11", maps)
    for _ in range(2):
        (line,) = ssrvlad(*base, "cityscapes-trainids", other)[2]
        assert line.endswith("db also holds frames of camvid-11")
    assert ssrvlad(*base, "camvid-11", other)[2] == []


def refused_by_the_disk(*_):
    raise OSError("full")


def test_a_first_run_that_fails_leaves_no_database(encode, maps, tmp_path, monkeypatch):
    town, command = tmp_path / "town", (maps, "-o", tmp_path / "town", "--json")
    _, *others = sorted(maps.iterdir())
    uniform(maps, [77])
    for path in others:
        path.rename(path.with_suffix(".later"))
    code, out, _ = encode(*command)
    assert (code, json.loads(out)["encoded"], town.exists()) == (2, 0, False)
    for path in others:
        path.with_suffix(".later").rename(path)
    with monkeypatch.context() as full:
        full.setattr(engine, "write_fragments", refused_by_the_disk)
        for linked in (False, True):
            if linked:
                (tmp_path / "disk").mkdir()
                town.symlink_to(tmp_path / "disk")
            code, _, err = encode(*command)
            assert (code, err) == (2, [f"ssrvlad: {town} cannot be written: full"])
            assert [*town.iterdir()] == [] if linked else not town.exists()
    code, out, _ = encode(*command)
    assert (code, json.loads(out)["frames"]) == (3, 5)
    monkeypatch.setattr(engine, "write_fragments", refused_by_the_disk)
    others[0].touch()
    assert encode(*command)[0] == 2
    assert len(Database.open(town)) == 5


def test_without_a_terminal_progress_is_lines(encode, maps, tmp_path, monkeypatch):
    monkeypatch.setattr(output, "_LINE_SECONDS", 0.0)
    _, _, err = encode(maps, "-o", tmp_path / "db")
    assert re.fullmatch(r"ssrvlad: encoding: \d of 6 after \d+ s", err[-1])


def test_an_empty_frame_is_counted_and_never_matches(ssrvlad, encode, maps, tmp_path):
    uniform(maps, [VOID])
    db = tmp_path / "empty.ssrdb"
    assert "6 frames encoded (1 of them empty)" in encode(maps, "-o", db)[1]
    out = ssrvlad("query", db, maps, "--top", 6)[1]
    assert out.startswith("monday/000: no candidate") and "monday/000 " not in out


@pytest.fixture
def photos(maps, tmp_path):
    """``photos/monday``, the world of ``maps`` as a camera sees it, and ``net.yaml``, which labels
    it."""
    write_settings(tmp_path)
    folder = tmp_path / "photos" / "monday"
    for path in maps.iterdir():
        write_image(folder / path.name, photo(np.asarray(Image.open(path))))
    return folder


def test_images_and_a_segmenter_give_what_label_maps_give(
    ssrvlad, encode, database, photos, tmp_path
):
    db, segmenter = tmp_path / "photos.ssrdb", ["--segmenter", tmp_path / "net.yaml"]
    code, out, (line,) = encode(photos, "-o", db, *segmenter)
    assert code == 0 and "stored without features: " in line
    assert "6 frames encoded (0 of them empty), 0 already there, 0 skipped" in out
    by_labels, by_images = Database.open(database).load(), Database.open(db).load()
    assert by_images.frames == by_labels.frames
    assert torch.equal(by_images.descriptors, by_labels.descriptors)
    again = encode(photos, "-o", db, *segmenter)[1]
    assert "0 frames encoded (0 of them empty), 6 already there" in again

    alike = ["--sequence", "monday"]
    code, out, _ = ssrvlad("query", database, photos, "--top", 1, *segmenter, *alike)
    assert (code, out) == (0, ssrvlad("query", database, tmp_path / "monday", "--top", 1)[1])

    options = ["--tolerance-frames", 1, "--json", "--channel", "ssr-vlad", *alike]
    code, out, _ = ssrvlad("evaluate", database, photos, *options, *segmenter)
    assert (code, out) == (0, ssrvlad("evaluate", db, tmp_path / "monday", *options)[1])


def test_a_network_of_other_classes_is_refused_at_its_first_picture(ssrvlad, photos, tmp_path):
    network = ("--segmenter", tmp_path / "net.onnx", "--labels-as", "synthia")
    code, out, lines = ssrvlad("encode", photos, "-o", tmp_path / "db", *network)
    assert (code, out) == (2, "") and not (tmp_path / "db").exists()
    assert "net.onnx: no output fits label space synthia: got found (6, 12, 24, 32)" in lines[-1]


def test_another_segmenter_encodes_anew_and_says_so(encode, photos, tmp_path):
    """The same network, with other normalisation, labels the same pictures otherwise."""
    settings = (tmp_path / "net.yaml").read_text()
    (tmp_path / "other.yaml").write_text(settings.replace("std: [1, 1, 1]", "std: [2, 2, 2]"))
    command = [photos, "-o", tmp_path / "db", "--segmenter"]
    assert "6 frames encoded" in encode(*command, tmp_path / "net.yaml")[1]
    assert "6 encoded anew: segmenter changed" in encode(*command, tmp_path / "other.yaml")[1]
    assert "6 already there" in encode(*command, tmp_path / "other.yaml")[1]
