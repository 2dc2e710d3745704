"""What README.md and the help texts tell a user to type, typed."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from ssrvlad_torch import cli
from ssrvlad_torch.datasets.synthetic_city import write_city

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
CONSOLE = re.findall(r"```console\n(.*?)```", README, re.DOTALL)
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """``maps/monday``, ``maps/tuesday`` and ``maps/today`` with poses, as in the examples."""
    folder = tmp_path_factory.mktemp("user")
    write_city(folder / "city", frames=43, size=(48, 64), labels_as="cityscapes-ids")
    (folder / "maps").mkdir()
    for day, sequence in (("monday", "reference"), ("tuesday", "query"), ("today", "query")):
        shutil.copytree(folder / "city" / sequence, folder / "maps" / day)
    poses = (folder / "city" / "poses.csv").read_text()
    again = "".join(line for line in poses.splitlines(True) if line.startswith("query/"))
    for sequence, day in (("reference/", "monday/"), ("query/", "today/")):
        poses = poses.replace(sequence, day)
    (folder / "maps" / "poses.csv").write_text(poses + again.replace("query/", "tuesday/"))
    return folder


@pytest.fixture
def run(maps, monkeypatch, capsys):
    def command_line(line: str) -> str:
        words = shlex.split(line.replace("camvid-11", "cityscapes-ids"))
        monkeypatch.chdir(maps)
        monkeypatch.setattr("sys.argv", words)
        with pytest.raises(SystemExit) as end:
            cli.main()
        out, err = capsys.readouterr()
        assert end.value.code in (0, None), err
        return out

    return command_line


def test_command_1_stands_by_line_15():
    assert "$ scripts/demo" in README.splitlines()[:15]


def test_command_1_prints_what_the_readme_shows(run):
    assert "$ scripts/demo\n" + run("ssrvlad demo") == CONSOLE[0]


def test_the_other_commands_in_order(run, maps):
    for line in CONSOLE[1].splitlines():
        assert run(line.removeprefix("$ "))
    assert (maps / "frame.png").exists()


@pytest.mark.parametrize("block", range(len(PYTHON)))
def test_python(block, run, maps, monkeypatch):
    run("ssrvlad encode maps/monday -o town.ssrdb --labels-as camvid-11")
    monkeypatch.chdir(maps)
    exec("\n".join(PYTHON[: block + 1]), {})


def test_every_command_is_in_the_table(run):
    commands = re.findall(
        r"^  (\w+)", run("ssrvlad --help").partition("Commands:")[2], re.MULTILINE
    )
    assert commands
    for command in commands:
        assert f"| `ssrvlad {command} " in README or f"| `ssrvlad {command}`" in README


@pytest.mark.parametrize(
    "command", ["encode", "query", "evaluate", "show", "db info", "city", "demo"]
)
def test_help_examples(command, run, maps, tmp_path):
    run("ssrvlad encode maps/monday -o town.ssrdb --labels-as camvid-11")
    text = " ".join(run(f"ssrvlad {command} --help").split())
    example = re.search(r"Example: (ssrvlad .*?) (Arguments|Options):", text)
    assert example, text
    line = example[1].replace("/tmp/", f"{tmp_path}/")
    assert run(line)


def test_links_lead_somewhere():
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", README):
        assert (Path(__file__).parents[1] / target).exists(), target
