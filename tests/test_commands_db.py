"""`ssrvlad db verify` and `db export`, and what `encode` and `query` do with a database."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from drives import write_maps
from helpers import spoil

from ssrvlad_torch.database.database import Database
from ssrvlad_torch.taxonomy import label_space


def test_verify_finds_nothing_in_a_whole_database(ssrvlad, database):
    assert ssrvlad("db", "verify", database) == (0, f"{database}: 6 frames, 0 damaged\n", [])
    code, out, _ = ssrvlad("db", "verify", database, "--json")
    assert (code, json.loads(out)) == (0, {"frames": 6, "damage": []})


def test_verify_names_the_file_and_can_drop_what_is_damaged(ssrvlad, database, maps):
    file = spoil(database, Database.open(database).load().descriptors[2])
    code, _, err = ssrvlad("db", "verify", database)
    assert (code, len(err)) == (3, 1)
    assert f"{file}: 1 frames lost: " in err[0]
    code, out, _ = ssrvlad("db", "verify", database, "--json")
    [damage] = json.loads(out)["damage"]
    assert (code, damage["file"], damage["rows"]) == (3, f"data/{file.name}", 1)

    code, _, err = ssrvlad("query", database, maps)
    assert code == 2
    assert file.name in err[0]
    code, _, err = ssrvlad("db", "verify", database, "--drop-damaged")
    assert code == 3
    assert "now holds the 5 undamaged frames" in err[-1]
    assert ssrvlad("db", "verify", database)[0] == 0
    code, out, _ = ssrvlad("encode", maps, "-o", database, "--labels-as", "camvid-11")
    assert "1 frames encoded" in out


def test_labels_are_read_by_the_stored_label_space_from_any_folder(
    ssrvlad, maps, tmp_path, monkeypatch
):
    """The file that defined it is gone."""
    (tmp_path / "else").mkdir()
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(yaml.safe_dump(label_space("camvid-11").to_dict()))
    assert ssrvlad("encode", maps, "-o", "town.ssrdb", "--labels-as", "mine.yaml")[0] == 0
    Path("mine.yaml").unlink()
    monkeypatch.chdir(tmp_path / "else")
    town = tmp_path / "town.ssrdb"
    write_maps(tmp_path / "tuesday", range(3))
    assert "6 already there" in ssrvlad("encode", maps, "-o", town)[1]
    assert "3 frames encoded" in ssrvlad("encode", tmp_path / "tuesday", "-o", town)[1]
    assert "camvid-11 9" in ssrvlad("db", "info", town)[1]
    code, out, err = ssrvlad("query", town, maps, "--json", "--top", 1)
    assert (code, err) == (0, [])
    assert candidates(out).keys() == {f"monday/00{n}" for n in range(6)}
    page = tmp_path / "page.html"
    arguments = ("--tolerance-frames", 1, "--json", "--report", page)
    assert ssrvlad("evaluate", town, maps, *arguments)[0] == 0
    assert page.stat().st_size


def test_history_tells_versions_that_other_commands_take(ssrvlad, database, maps, tmp_path):
    write_maps(tmp_path / "tuesday", range(2))
    ssrvlad("encode", tmp_path / "tuesday", "-o", database, "--labels-as", "camvid-11")
    lines = [
        json.loads(line) for line in ssrvlad("db", "history", database, "--json")[1].splitlines()
    ]
    assert [line["frames"] for line in lines][-2:] == [6, 8]
    assert "merge 2 frames" in ssrvlad("db", "history", database)[1].splitlines()[-1]
    before = ("--as-of", lines[-2]["version"])
    assert json.loads(ssrvlad("db", "info", database, "--json", *before)[1])["frames"] == 6
    out = ssrvlad("query", database, tmp_path / "tuesday", "--json", *before)[1]
    assert not any("tuesday" in frame for found in candidates(out).values() for frame in found)
    file = tmp_path / "out.npy"
    assert ssrvlad("db", "export", database, "--format", "npy", "-o", file, *before)[0] == 0
    assert np.load(file).shape == (6, 480)
    code, out, _ = ssrvlad("db", "compact", database, "--keep-days", 0)
    assert (code, out) == (0, f"{database}: 8 frames, 1 versions kept\n")
    code, _, err = ssrvlad("db", "info", database, *before)
    left = Database.open(database).version
    assert (code, err) == (2, [f"ssrvlad: {database} has no version {before[1]}; it has {left}"])


def test_encode_tells_what_is_gone_and_prunes_it(ssrvlad, database, maps):
    (maps / "003.png").unlink()
    arguments = ("encode", maps, "-o", database, "--labels-as", "camvid-11")
    code, out, err = ssrvlad(*arguments)
    assert code == 0
    assert "5 already there" in out
    assert err == [
        f"ssrvlad: monday/003 is in {database}, but its file is gone; --prune removes it"
    ]
    assert ssrvlad(*arguments, "--every", 2)[2] == []
    code, _, err = ssrvlad(*arguments, "--every", 2, "--prune")
    assert code == 2
    assert "--prune needs whole folders" in err[0]
    code, out, err = ssrvlad(*arguments, "--prune")
    assert (code, err) == (0, [])
    assert "1 removed" in out
    assert len(Database.open(database)) == 5


def test_encode_tells_what_has_changed(ssrvlad, database, maps):
    (maps / "003.png").unlink()
    (maps / "004.png").rename(maps / "003.png")
    code, out, _ = ssrvlad("encode", maps, "-o", database, "--labels-as", "camvid-11", "--json")
    report = json.loads(out)
    assert (code, report["anew"], report["already_there"]) == (0, {"file changed": 1}, 4)
    assert report["gone"] == ["monday/004"]


def test_ray_that_is_not_installed_is_named(ssrvlad, maps, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    arguments = ("encode", maps, "-o", tmp_path / "db", "--labels-as", "camvid-11")
    code, _, err = ssrvlad(*arguments, "--engine", "ray")
    if code != 2:
        pytest.skip("the command runs in a process of its own")
    assert "pip install ssrvlad-torch[ray]" in err[0]


def candidates(out):
    lines = [json.loads(line) for line in out.splitlines()]
    return {line["query"]: [c["frame"] for c in line["candidates"]] for line in lines}


def test_a_query_can_be_limited(ssrvlad, database, maps, tmp_path):
    write_maps(tmp_path / "tuesday", range(4))
    ssrvlad("encode", tmp_path / "tuesday", "-o", database, "--labels-as", "camvid-11")
    query = ("query", database, maps, "--json", "--top", 20, "--temporal", 0)
    found = candidates(ssrvlad(*query, "--from-sequence", "tuesday")[1])["monday/002"]
    assert sorted(found) == [f"tuesday/00{n}" for n in range(4)]
    found = candidates(ssrvlad(*query, "--exclude", 1)[1])["monday/002"]
    assert not {"monday/001", "monday/002", "monday/003"} & set(found)
    assert {"monday/000", "monday/004", "tuesday/002"} <= set(found)
    assert ssrvlad(*query, "--from-sequence", "never")[0] == 2


def test_a_database_is_a_source_of_queries(ssrvlad, database, maps, tmp_path):
    other = tmp_path / "tuesday.ssrdb"
    write_maps(tmp_path / "tuesday", range(2, 5))
    ssrvlad("encode", tmp_path / "tuesday", "-o", other, "--labels-as", "camvid-11")
    code, out, err = ssrvlad("query", database, other, "--json", "--top", 1)
    assert (code, err) == (0, [])
    assert candidates(out) == {f"tuesday/00{n}": [f"monday/00{n}"] for n in (2, 3, 4)}
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps({f"tuesday/00{n}": [f"monday/00{n}"] for n in (2, 3, 4)}))
    code, out, _ = ssrvlad("evaluate", database, other, "--ground-truth", truth, "--json")
    assert (code, json.loads(out)["recall_at"]["1"], json.loads(out)["queries"]) == (0, 1.0, 3)
    paper = tmp_path / "paper.ssrdb"
    arguments = ("-o", paper, "--labels-as", "camvid-11", "--preset", "paper")
    ssrvlad("encode", tmp_path / "tuesday", *arguments)
    code, _, err = ssrvlad("query", database, paper)
    assert code == 2
    assert "their descriptors do not compare" in err[0]
