"""`ssrvlad db verify` and `db export`, and what `encode` and `query` do with a database."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from drives import write_maps
from helpers import flip_byte

from ssrvlad_torch.database.database import Database

PART = "part-000000.parquet"


def spoil(database):
    """Flips a bit of the descriptors of the first row group."""
    meta = pq.ParquetFile(database / PART).metadata.row_group(0)
    chunk = meta.column(meta.num_columns - 1)
    flip_byte(database / PART, chunk.data_page_offset + chunk.total_compressed_size // 2, 1)


def test_verify_finds_nothing_in_a_whole_database(ssrvlad, database):
    assert ssrvlad("db", "verify", database) == (0, f"{database}: 6 frames, no damage\n", [])
    code, out, _ = ssrvlad("db", "verify", database, "--json")
    assert (code, json.loads(out)) == (0, {"frames": 6, "damage": []})


def test_verify_names_file_and_row_group_and_can_drop_them(ssrvlad, database, maps):
    spoil(database)
    code, _, err = ssrvlad("db", "verify", database)
    assert code == 3
    assert len(err) == 1
    assert f"{database / PART}, row group 0: " in err[0]
    code, out, _ = ssrvlad("db", "verify", database, "--json")
    [damage] = json.loads(out)["damage"]
    assert (code, damage["file"], damage["row_group"]) == (3, PART, 0)

    code, _, err = ssrvlad("query", database, maps)
    assert code == 2
    assert PART in err[0]
    code, _, err = ssrvlad("db", "verify", database, "--drop-damaged")
    assert code == 3
    assert "now holds the 0 frames that are whole" in err[-1]
    assert ssrvlad("db", "verify", database)[0] == 0
    code, out, _ = ssrvlad("encode", maps, "-o", database, "--labels-as", "camvid-11")
    assert "6 frames encoded" in out


def test_a_damaged_manifest_is_named(ssrvlad, database):
    flip_byte(database / "manifest.json", (database / "manifest.json").read_text().index("sha256"))
    code, _, err = ssrvlad("db", "verify", database)
    assert code in (2, 3)
    assert len(err) == 1
    assert "manifest.json" in err[0]


def test_a_query_reads_on_past_damage_only_if_told_to(ssrvlad, database, maps, tmp_path):
    write_maps(tmp_path / "tuesday", range(2))
    ssrvlad("encode", tmp_path / "tuesday", "-o", database, "--labels-as", "camvid-11")
    spoil(database)
    assert ssrvlad("query", database, maps)[0] == 2
    code, out, err = ssrvlad("query", database, maps, "--skip-damaged", "--json")
    assert code == 0
    assert len(err) == 1
    assert "left out" in err[0]
    assert PART in err[0]
    for line in out.splitlines():
        frames = {candidate["frame"] for candidate in json.loads(line)["candidates"]}
        assert frames == {"tuesday/000", "tuesday/001"}


@pytest.mark.parametrize("form", ["npy", "faiss", "hloc"])
def test_export_writes_each_form(ssrvlad, database, tmp_path, form):
    pytest.importorskip("faiss", reason="needs the extra search")
    pytest.importorskip("h5py", reason="needs the extra search")
    file = tmp_path / "out"
    code, out, _ = ssrvlad("db", "export", database, "--format", form, "-o", file)
    assert code == 0
    assert out.splitlines()[0] == str(file)
    if form == "npy":
        wanted = Database.open(database).load().descriptors.numpy()
        np.testing.assert_array_equal(np.load(file), wanted)


def test_encode_tells_what_is_gone_and_prunes_it(ssrvlad, database, maps):
    (maps / "003.png").unlink()
    arguments = ("encode", maps, "-o", database, "--labels-as", "camvid-11")
    code, out, err = ssrvlad(*arguments)
    assert code == 0
    assert "5 already there" in out
    assert err == [f"ssrvlad: monday/003 is in {database} and its file is gone; --prune removes it"]
    assert ssrvlad(*arguments, "--every", 2)[2] == []
    code, _, err = ssrvlad(*arguments, "--every", 2, "--prune")
    assert code == 2
    assert "--prune wants whole folders" in err[0]
    code, out, err = ssrvlad(*arguments, "--prune")
    assert (code, err) == (0, [])
    assert "1 removed" in out
    assert len(Database.open(database)) == 5


def test_encode_tells_what_has_changed(ssrvlad, database, maps):
    (maps / "003.png").unlink()
    (maps / "004.png").rename(maps / "003.png")
    code, out, _ = ssrvlad("encode", maps, "-o", database, "--labels-as", "camvid-11", "--json")
    report = json.loads(out)
    assert (code, report["changed"], report["already_there"]) == (0, 1, 4)
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
    found = candidates(ssrvlad(*query, "--window", "2:3")[1])["monday/002"]
    assert sorted(found) == ["monday/002", "monday/003", "tuesday/002", "tuesday/003"]
    found = candidates(ssrvlad(*query, "--exclude", 1)[1])["monday/002"]
    assert not {"monday/001", "monday/002", "monday/003"} & set(found)
    assert {"monday/000", "monday/004", "tuesday/002"} <= set(found)
    code, _, err = ssrvlad(*query, "--window", "2")
    assert (code, err) == (2, ["ssrvlad: --window wants FIRST:LAST in whole numbers, got '2'"])
    assert ssrvlad(*query, "--from-sequence", "never")[0] == 2


def test_every_way_to_search_finds_the_same(ssrvlad, database, maps):
    query = ("query", database, maps, "--json", "--top", 3)
    wanted = ssrvlad(*query)[1]
    assert ssrvlad(*query, "--index", "mapped")[1] == wanted
    half = candidates(ssrvlad(*query, "--index", "mapped", "--precision", "float16")[1])
    assert [found[0] for found in half.values()] == [f[0] for f in candidates(wanted).values()]
    assert ssrvlad(*query, "--precision", "float16")[0] == 0
    code, _, err = ssrvlad(*query, "--index", "faiss-ivfpq")
    assert code == 2
    assert "wants at least 9984 references" in err[0] or "ssrvlad-torch[search]" in err[0]
