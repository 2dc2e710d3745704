"""`ssrvlad db`, and what `encode` and `query` do with a database."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import spoil, write_maps, write_truth

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.taxonomy import label_space


@pytest.fixture
def tuesday(tmp_path):
    return write_maps(tmp_path / "tuesday", range(4))


@pytest.fixture
def candidates(ssrvlad):
    """The candidates of each query, and what stands on stderr."""

    def run(*arguments: object) -> tuple[dict[str, list[str]], list[str]]:
        code, out, err = ssrvlad("query", *arguments, "--json")
        assert code == 0
        lines = map(json.loads, out.splitlines())
        return {line["query"]: [c["frame"] for c in line["candidates"]] for line in lines}, err

    return run


def test_info_prints_preset_label_spaces_and_settings(ssrvlad, database):
    code, out, _ = ssrvlad("db", "info", database)
    assert code == 0
    assert "frames: 6" in out and "sequences: monday 6" in out
    assert "channels" not in out and "thinning" not in out and "anchor vanishing-column" in out
    info = json.loads(ssrvlad("db", "info", database, "--json")[1])
    assert info["preset"] == "default"
    assert info["label_spaces"] == {"camvid-11": 6}
    assert info["config"] == SSRVLADConfig.from_preset("default", labels_as="camvid-11").to_dict()


def test_verify_names_the_file_and_can_drop_what_is_damaged(
    ssrvlad, encode, refusal, database, maps
):
    assert ssrvlad("db", "verify", database) == (0, f"{database}: 6 frames, 0 damaged\n", [])
    code, out, _ = ssrvlad("db", "verify", database, "--json")
    assert (code, json.loads(out)) == (0, {"frames": 6, "damage": [], "index": []})

    file = spoil(database, Database.open(database).load().descriptors[2])
    code, _, (line,) = ssrvlad("db", "verify", database)
    assert code == 3 and f"{file}: 1 frames lost: " in line
    code, out, _ = ssrvlad("db", "verify", database, "--json")
    [damage] = json.loads(out)["damage"]
    assert (code, damage["file"], damage["rows"]) == (3, f"data/{file.name}", 1)
    assert file.name in refusal("query", database, maps)

    code, _, err = ssrvlad("db", "verify", database, "--drop-damaged")
    assert code == 3 and "now holds the 5 undamaged frames" in err[-1]
    assert ssrvlad("db", "verify", database)[0] == 0
    assert "1 frames encoded" in encode(maps, "-o", database)[1]


def test_labels_are_read_by_the_stored_label_space_from_any_folder(
    ssrvlad, candidates, maps, tuesday, tmp_path, monkeypatch
):
    """The file that defined it is gone."""
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(yaml.safe_dump(label_space("camvid-11").to_dict()))
    assert ssrvlad("encode", maps, "-o", "town.ssrdb", "--labels-as", "mine.yaml")[0] == 0
    Path("mine.yaml").unlink()
    Path("else").mkdir()
    monkeypatch.chdir("else")
    town = tmp_path / "town.ssrdb"
    assert "6 already there" in ssrvlad("encode", maps, "-o", town)[1]
    assert "4 frames encoded" in ssrvlad("encode", tuesday, "-o", town)[1]
    assert "camvid-11 10" in ssrvlad("db", "info", town)[1]
    found, err = candidates(town, maps, "--top", 1)
    assert (found.keys(), err) == ({f"monday/00{n}" for n in range(6)}, [])
    page = tmp_path / "page.html"
    arguments = ("--tolerance-frames", 1, "--json", "--report", page)
    assert ssrvlad("evaluate", town, maps, *arguments)[0] == 0
    assert page.stat().st_size


def test_history_tells_versions_that_other_commands_take(
    ssrvlad, encode, candidates, refusal, database, tuesday, tmp_path
):
    encode(tuesday, "-o", database)
    lines = [*map(json.loads, ssrvlad("db", "history", database, "--json")[1].splitlines())]
    assert [line["frames"] for line in lines][-2:] == [6, 10]
    assert "merge 4 frames" in ssrvlad("db", "history", database)[1].splitlines()[-1]
    before = ("--as-of", lines[-2]["version"])
    assert json.loads(ssrvlad("db", "info", database, "--json", *before)[1])["frames"] == 6
    found, _ = candidates(database, tuesday, *before)
    assert not any("tuesday" in frame for frames in found.values() for frame in frames)
    file = tmp_path / "out.npy"
    assert ssrvlad("db", "export", database, "--format", "npy", "-o", file, *before)[0] == 0
    assert np.load(file).shape == (6, 480)
    code, out, _ = ssrvlad("db", "compact", database, "--keep-days", 0)
    assert (code, out) == (0, f"{database}: 10 frames, 1 versions kept\n")
    left = Database.open(database).version
    refused = f"ssrvlad: {database} has no version {before[1]}; it has {left}"
    assert refusal("db", "info", database, *before) == refused


def test_encode_tells_what_is_gone_or_has_changed_and_prunes_it(encode, refusal, database, maps):
    (maps / "003.png").unlink()
    (maps / "004.png").rename(maps / "003.png")
    arguments = (maps, "-o", database)
    code, out, (line,) = encode(*arguments, "--json")
    report = json.loads(out)
    assert (code, report["anew"], report["already_there"]) == (0, {"file changed": 1}, 4)
    assert report["gone"] == ["monday/004"]
    gone = f"ssrvlad: monday/004 is in {database}, but its file is gone; --prune removes it"
    assert line == gone
    assert encode(*arguments, "--every", 2)[2] == []
    refused = refusal("encode", *arguments, "--labels-as", "camvid-11", "--every", 2, "--prune")
    assert "--prune needs whole folders" in refused
    code, out, err = encode(*arguments, "--prune")
    assert (code, err) == (0, []) and "1 removed" in out
    assert len(Database.open(database)) == 5


def test_of_many_frames_that_are_gone_twenty_are_named(encode, maps, tmp_path):
    maps, town = write_maps(maps, range(23)), tmp_path / "many"
    encode(maps, "-o", town)
    for path in sorted(maps.iterdir())[1:]:
        path.unlink()
    err = encode(maps, "-o", town)[2]
    assert len(err) == 21 and err[-1] == "ssrvlad: gone: 2 more"


def test_candidates_are_limited_to_a_sequence_or_far_frames(
    candidates, encode, refusal, database, maps, tuesday
):
    encode(tuesday, "-o", database)
    query = (database, maps, "--top", 20, "--temporal", 0)
    found = candidates(*query, "--from-sequence", "tuesday")[0]["monday/002"]
    assert sorted(found) == [f"tuesday/00{n}" for n in range(4)]
    found = candidates(*query, "--exclude", 1)[0]["monday/002"]
    assert not {"monday/001", "monday/002", "monday/003"} & set(found)
    assert {"monday/000", "monday/004", "tuesday/002"} <= set(found)
    assert "never" in refusal("query", *query, "--from-sequence", "never")


def test_a_database_is_a_source_of_queries(
    ssrvlad, candidates, encode, refusal, database, tuesday, tmp_path
):
    other = tmp_path / "tuesday.ssrdb"
    truth = {f"tuesday/00{n}": [f"monday/00{n}"] for n in range(4)}
    encode(tuesday, "-o", other)
    assert candidates(database, other, "--top", 1) == (truth, [])
    file = write_truth(tmp_path / "truth.json", truth)
    code, out, _ = ssrvlad("evaluate", database, other, "--ground-truth", file, "--json")
    assert (code, json.loads(out)["recall_at"]["1"], json.loads(out)["queries"]) == (0, 1.0, 4)
    paper = tmp_path / "paper.ssrdb"
    encode(tuesday, "-o", paper, "--preset", "paper")
    assert "their descriptors do not compare" in refusal("query", database, paper)
