"""What README.md and the help texts tell a user to type, typed."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer
from networks import write_graph, write_published
from PIL import Image

from ssrvlad_torch import SSRVLAD, Database
from ssrvlad_torch.cli import main as cli
from ssrvlad_torch.cli.app import app
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.taxonomy import colourise

ROOT = Path(__file__).parents[1]
README, DOCS = ROOT / "README.md", ROOT / "docs"


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text("utf-8"), re.DOTALL)


CONSOLE, PYTHON = blocks(README, "console"), blocks(README, "python")


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """``maps/monday``, ``maps/tuesday`` and ``maps/today`` with poses, as in the examples."""
    folder = tmp_path_factory.mktemp("user")
    write_city(folder / "city", frames=43, size=(48, 64), labels_as="cityscapes-ids")
    for day, sequence in (("monday", "reference"), ("tuesday", "query"), ("today", "query")):
        shutil.copytree(folder / "city" / sequence, folder / "maps" / day)
    poses = (folder / "city" / "poses.csv").read_text().replace("reference/", "monday/")
    tuesday = [line.replace("query/", "tuesday/") for line in re.findall("query/.*\n", poses)]
    poses = poses.replace("query/", "today/") + "".join(tuesday)
    (folder / "maps" / "poses.csv").write_text(poses)
    return folder


def write_views(label_maps, folder):
    """What a camera sees of the first four label maps of a folder."""
    folder.mkdir(parents=True)
    for label_map in sorted(label_maps.iterdir())[:4]:
        picture = colourise(np.asarray(Image.open(label_map)), "cityscapes-ids")
        Image.fromarray(picture).resize((256, 192)).save(folder / label_map.name)


@pytest.fixture(scope="module")
def photos(maps):
    """``photos/monday`` and ``photos/today``, what a camera sees of the first frames of ``maps``,
    the data set ``town`` of both, a network, and weights that were never trained."""
    for day, role in (("monday", "reference"), ("today", "query")):
        write_views(maps / "maps" / day, maps / "photos" / day)
        shutil.copytree(maps / "photos" / day, maps / "town" / role / "images")
        (maps / "town" / role / "labels").mkdir()
        for picture in (maps / "photos" / day).iterdir():
            shutil.copy(maps / "maps" / day / picture.name, maps / "town" / role / "labels")
    shutil.copy(maps / "maps" / "poses.csv", maps / "photos")
    shutil.copy(maps / "city" / "poses.csv", maps / "town")
    truth = {f"query/{n:06d}": [f"reference/{n:06d}"] for n in range(4)}
    (maps / "town" / "ground_truth.json").write_text(json.dumps(truth))
    write_graph(maps / "net.onnx", labels=True)
    settings = blocks(DOCS / "guides" / "network.md", "yaml")[0]
    (maps / "seg.yaml").write_text(re.sub(r"(?m)^(labels_as|classes):.*\n", "", settings))
    return maps


@pytest.fixture(scope="module")
def town(maps):
    """``town.ssrdb``, the frames of Monday."""
    head = SSRVLAD.from_preset("default", labels_as="cityscapes-ids")
    database = Database.open_or_create(maps / "town.ssrdb", head.config)
    encode_to_database(head, find_label_files([str(maps / "maps" / "monday")]), database)


@pytest.fixture
def run(maps, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(maps / "cache"))

    def command_line(line: str) -> str:
        spaces = ("camvid-11", "cityscapes-ids")  # of the examples, and of `maps`
        if line.startswith(("ssrvlad export", "ssrvlad fuse")):
            spaces = ("cityscapes-trainids", "camvid-11")  # for which other tests trace the head
        words = shlex.split(line.replace(*spaces))
        monkeypatch.chdir(maps)
        monkeypatch.setattr("sys.argv", words)
        with pytest.raises(SystemExit) as end:
            cli.main()
        out, err = capsys.readouterr()
        assert end.value.code in (0, None), f"{out}{err}"
        return out

    return command_line


def test_command_1_stands_by_line_15_and_prints_what_the_readme_shows(run, maps):
    assert "$ scripts/demo" in README.read_text("utf-8").splitlines()[:15]
    assert "$ scripts/demo\n" + run("ssrvlad demo") == CONSOLE[0]
    assert Image.open(maps / "ssrvlad-demo" / "demo.png").width > 300


def test_the_commands_on_label_maps_run_in_order(run, maps):
    """In a folder of their own, with as many frames as the last one needs."""
    block = next(block for block in CONSOLE if "--labels-as" in block)
    lines = re.sub(r"\$ (ssrvlad city .*)", r"\1 --frames 43", block).replace("town", "village")
    outs = [run(line.removeprefix("$ ")) for line in lines.splitlines()]
    assert all(outs) and outs[-1] == "frame.png\n"
    assert Image.open(maps / "frame.png").width > 1000


def test_the_commands_on_images_and_the_map_run(run, maps):
    published = f"hf:{write_published(maps / 'segformer')}"
    for day in ("monday", "tuesday", "today"):
        write_views(maps / "maps" / day, maps / "images" / day)
    for line in next(block for block in CONSOLE if "--segmenter" in block).splitlines():
        assert run(re.sub(r"hf:\S+", published, line.removeprefix("$ ")))
    exec(next(block for block in PYTHON if "Map.open" in block), {})


def test_the_python_examples_run(town, photos, monkeypatch):
    monkeypatch.chdir(photos)
    exec("\n".join(block for block in PYTHON if "Map.open" not in block), {})


COMMANDS = typer.main.get_command(app).commands
NAMES = [*(COMMANDS.keys() - {"db"}), *(f"db {name}" for name in COMMANDS["db"].commands)]
FEW = {"city": "--frames 3", "demo": "--frames 3"}
"""Added to the examples of commands that would take long: the last of an option holds."""


@pytest.mark.parametrize("command", sorted(NAMES))
def test_every_command_is_in_the_table_and_its_help_has_examples(
    command, run, town, photos, tmp_path
):
    page = (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    assert re.search(rf"^\| `ssrvlad {command}[ `]", page, re.MULTILINE)
    if command == "verify":
        run("ssrvlad fuse seg.yaml -o place.onnx --labels-as cityscapes-trainids")
    if command == "locate":
        given = "--segmenter seg.yaml --labels-as cityscapes-trainids"
        run(f"ssrvlad encode photos/monday -o photos.ssrdb {given}")
    if command == "db index":
        ids = [f"drive/{n:06d}" for n in range(300)]
        vectors = np.random.default_rng(0).random((300, 8))
        Database.create(photos / "large.ssrdb", width=8).append(ids, vectors)
    text = " ".join(run(f"ssrvlad {command} --help").replace("\\\n", " ").split())
    text = re.split(r"(?:Arguments|Options):", text)[0]
    examples = re.findall(r"Example: (ssrvlad .*?)(?= Example:|\s*$)", text)
    assert examples, text
    for line in examples:
        database = "large.ssrdb" if command == "db index" else "town.ssrdb"
        typed = line.replace("/tmp/", f"{tmp_path}/").replace("town.ssrdb", database)
        assert run(f"{typed} {FEW.get(command, '')}")
