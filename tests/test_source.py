"""What frames are read with: data sets, and the network that the user or the database names."""

import json
import math

import numpy as np
import pytest
from drawings import SPACE
from helpers import refuses, street, write_image
from networks import photo

from ssrvlad_torch import Database
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.encoding.selection import FrameSelection
from ssrvlad_torch.encoding.source import open_frames

CITY = ("--labels-as", "cityscapes-trainids")


def camera(folder, seeds):
    """Photographs with noise, which are no label maps in colours."""
    noise = np.random.default_rng(0)
    for seed in seeds:
        pixels = photo(street(seed, 60, 80)).astype(int) + noise.integers(-2, 3, (60, 80, 3))
        write_image(folder / f"{seed}.png", pixels.clip(0, 255).astype(np.uint8))
    return folder


def test_every_command_takes_the_network_of_the_database(network, ssrvlad, maps, tmp_path):
    monday, tuesday = (camera(tmp_path / name, range(4)) for name in ("first", "second"))
    town, option = tmp_path / "drives", ("--segmenter", network)
    assert ssrvlad("encode", monday, "-o", town, *option)[0] == 0

    def clear():
        after = Database.open(town)
        after.remove([frame for frame in after.load().frames if not frame.startswith("first/")])

    for command in (
        ("query", town, tuesday, "--json"),
        ("evaluate", town, tuesday, "--tolerance-frames", 0, "--json"),
        ("loops", tuesday, "--memory", town, "--json"),
        ("encode", tuesday, "-o", town, "--json"),
    ):
        expected = ssrvlad(*command, *option)[1]
        clear()
        code, out, err = ssrvlad(*command)
        assert (code, without_version(out)) == (0, without_version(expected)), (command, err)
        clear()
        assert err[0] == f"ssrvlad: {network}, the network of {town}, labels the pictures"
    code, _, err = ssrvlad("query", town, maps, "--channel", "ssr-vlad")
    assert (code, len(err)) == (0, 1), "label maps need no network"


def without_version(out):
    lines = [json.loads(line) for line in out.splitlines()]
    return [{key: line[key] for key in line.keys() - {"version"}} for line in lines]


def test_an_assumed_preparation_is_noted_unless_accepted(network, ssrvlad, refusal, tmp_path):
    options = ("--labels-as", SPACE, "--segmenter")
    accepting = {value: tmp_path / f"{value}.yaml" for value in ("true", "false", "3")}
    for value, path in accepting.items():
        path.write_text(f"network: net.onnx\nsize: 60\naccept_defaults: {value}\n")
    notes = {network: 0, tmp_path / "net.onnx": 1, accepting["true"]: 0, accepting["false"]: 1}
    for name, count in notes.items():
        town = tmp_path / f"town of {name.name}"
        _, _, err = ssrvlad("encode", tmp_path / "photos", "-o", town, *options, name)
        assumed = [line for line in err if "assumed: rgb, 0 to 1, mean (0.485, 0.456" in line]
        assert len(assumed) == count
        accepted = "(accept_defaults: true in a YAML file accepts that)"
        assert all(accepted in line for line in assumed)
    line = refusal("encode", tmp_path / "photos", "-o", tmp_path / "x", *options, accepting["3"])
    assert "3.yaml: accept_defaults must be true or false, got 3" in line


@pytest.fixture
def city(tmp_path):
    """Eight frames of both drives through the city."""
    write_city(tmp_path / "city", frames=8, seed=1, size=(60, 80))
    return tmp_path / "city"


@pytest.fixture
def reference(ssrvlad, city, tmp_path):
    """A database of the references, the roles being those of the data set."""
    db = tmp_path / "roles.ssrdb"
    options = (*CITY, "--layout", "auto", "--role", "reference")
    code, out, _ = ssrvlad("encode", city, "-o", db, *options)
    assert (code, "8 frames encoded" in out) == (0, True)
    return db


@pytest.mark.parametrize(
    ("space", "kinds", "chosen"),
    [
        ("cityscapes-trainids", "color labelIds labelTrainIds instanceIds", "labelTrainIds"),
        ("cityscapes-trainids", "color labelIds instanceIds", "color"),
        ("cityscapes-ids", "color labelIds labelTrainIds instanceIds", "labelIds"),
        ("cityscapes-ids", "invIds labelColor labelTrainIds", "labelColor"),
        ("cityscapes-ids", "instanceIds", "instanceIds"),
    ],
)
def test_a_folder_of_gtfine_gives_each_place_once(tmp_path, space, kinds, chosen):
    for number in range(3):
        for kind in kinds.split():
            write_image(tmp_path / "aachen" / f"{number}_gtFine_{kind}.png", street(0))
    notes = []
    selection = FrameSelection([str(tmp_path / "aachen")], labels_as=space, every=2)
    files = open_frames(selection, note=notes.append).files
    assert [file.name for file in files] == [f"{n}_gtFine_{chosen}" for n in (0, 2)]
    assert len(notes) == (len(kinds.split()) > 1)


def test_roles_and_truth_come_from_the_data_set(ssrvlad, city, reference, tmp_path):
    db = tmp_path / "folders.ssrdb"
    ssrvlad("encode", city / "reference", "-o", db, *CITY)
    truth = ("--ground-truth", city / "ground_truth.json")
    by_folders = ssrvlad("evaluate", db, city / "query", *truth, "--json")
    whole = ("evaluate", reference, city, "--layout", "auto", "--role", "query")
    assert ssrvlad(*whole, "--json") == by_folders
    assert json.loads(by_folders[1])["queries"] == 8
    assert ssrvlad(*whole, "--tolerance-metres", 5, "--json")[1] == by_folders[1]
    assert ssrvlad(*whole[:3], "--layout", "folders", "--split", "q*", "--json") == by_folders
    places = ((city / "query",), (city, "--layout", "auto", "--split", "query"))
    lines = [ssrvlad("query", reference, *where, "--top", 2)[1] for where in places]
    assert lines[0] == lines[1] != ""
    for limit, count in (((), 8), ((180,), 8), ((0,), 0)):
        options = ("--tolerance-metres", 5, *(("--tolerance-degrees", *limit) if limit else ()))
        out = ssrvlad("evaluate", reference, city / "query", *options, "--json")[1]
        assert json.loads(out)["queries_with_match"] == count, "headings can count"


@pytest.mark.parametrize(
    ("paths", "settings", "message"),
    [
        ("monday", {}, "expected a list of folders, files or globs, got 'monday'"),
        ([], {}, r"expected a list of folders, files or globs, got \[\]"),
        (["a"], {"every": 0}, "every >= 1 and start >= 0, got 0 and 0"),
        (["a"], {"start": -1}, "every >= 1 and start >= 0, got 1 and -1"),
        *((["a"], {"fps": fps}, "expected fps above 0") for fps in (0, -1, math.nan, math.inf)),
        (["a"], {"split": ["b"]}, "--split, --role and --labels need --layout, such as --layout"),
        (["a"], {"role": "query"}, "need --layout"),
        (["a"], {"labels": "maps"}, "need --layout"),
        (["a"], {"layout": "auto", "sequence": "b"}, "--sequence, --poses, --topic and --fps do"),
        (["a", "b"], {"layout": "auto"}, "--layout: expected the folder of one data set, got 2"),
    ],
)
def test_a_selection_that_means_nothing_is_refused(paths, settings, message):
    refuses(message, FrameSelection, paths, **settings)
