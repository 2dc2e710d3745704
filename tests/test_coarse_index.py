"""The coarse index: of which rows and channels, grown, opened, refused."""

import errno
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import SPACE
from drives import write_maps
from helpers import descriptors, refuses, spoil
from large_maps import CONFIG

from ssrvlad_torch import Database, Map
from ssrvlad_torch.channels import Column
from ssrvlad_torch.search import coarse_index
from ssrvlad_torch.search.coarse_index import CoarseIndex, build, damaged
from ssrvlad_torch.search.sums import sums

SIGNS = Column("signs", "few", (4, 2, 4), "uint8")


def rows(first, count):
    """Descriptors by two channels."""
    signs = np.random.default_rng(first).integers(0, 256, (count, *SIGNS.shape), np.uint8)
    return {"ssr-vlad": descriptors(first, count), "signs": torch.from_numpy(signs)}


def add(database, first, count):
    database.append([f"a/{first + n:04d}" for n in range(count)], rows(first, count))


@pytest.fixture
def town(tmp_path):
    """100 frames by two channels."""
    database = Database.create(tmp_path / "town.ssrdb", CONFIG, columns=[SIGNS])
    add(database, 0, 100)
    return database


def assert_own_row_is_first(database, frame, query):
    """That of all rows the one that equals a query has its highest score by every channel."""
    frames, stored = database.placed()
    expected = int(stored[frames.frames.index(frame)])
    index = CoarseIndex(database)
    for name, vectors in query.items():
        scores = index.scan(name, [vectors[0]])[0]
        assert len(scores) == len(database) and int(scores.argmax()) == expected
    some = torch.arange(len(database)).flip(0)
    again = index.rescan("signs", query["signs"][0], some, True)
    assert int(some[again.argmax()]) == expected and float(again.max()) == 1
    assert index.rescan("ssr-vlad", query["ssr-vlad"][0], some, True) is None


def test_every_row_is_scanned_also_after_changes_of_the_map(town):
    report = build(town)
    assert (report.new, report.frames) == (100, 100) and report.bytes > 100 * 64
    assert_own_row_is_first(town, "a/0000", rows(0, 1))
    add(town, 100, 70)
    refuses("lacks 70 of 170 frames; ssrvlad db index adds them", CoarseIndex, town)
    assert build(town).new == 70
    assert_own_row_is_first(town, "a/0100", rows(100, 1))
    town.remove(["a/0003", "a/0100"])
    assert build(town)[:2] == (0, 168)
    town.merge(["a/0000"], rows(500, 1))
    build(town)
    assert_own_row_is_first(town, "a/0000", rows(500, 1))
    town.compact(keep_days=0)
    assert build(town).new == 168
    assert_own_row_is_first(town, "a/0000", rows(500, 1))
    kept = {file.name.split(".")[0] for file in Path(town.path, "_coarse").glob("*/*.npy")}
    assert kept == {file.stem for file in Path(town.path, "data").glob("*.lance")}


def test_rows_that_were_removed_before_are_left_out(town):
    town.remove([f"a/{n:04d}" for n in range(0, 100, 3)])
    assert build(town).frames == 66
    assert_own_row_is_first(town, "a/0001", {n: v[1:2] for n, v in rows(0, 2).items()})


def test_means_are_of_the_rows_that_are_there_now(town):
    """Also where a sequence is in several data files, or rows were removed later."""
    build(town)
    add(town, 100, 40)
    town.append([f"b/{n}" for n in range(5)], rows(7, 5))
    build(town)

    def assert_equal_means():
        frames, index = town.load(), CoarseIndex(town)
        for names in (["a"], ["b"], ["b", "a"]):
            of = [each in names for each in frames.sequences]
            for name, values in frames.channels.items():
                total, counted = sums(values[torch.tensor(of)])
                expected = torch.from_numpy(total / counted).float()
                torch.testing.assert_close(index.mean(name, names), expected, atol=1e-6, rtol=0)

    assert_equal_means()
    town.remove(["a/0003", "a/0120", "b/2"])
    assert_equal_means()
    next(Path(town.path, "_coarse").glob("*/*.sums.npz")).unlink()
    refuses("lacks", CoarseIndex, town)
    build(town)
    assert_equal_means()


def test_a_map_that_has_grown_much_is_learnt_anew(town, monkeypatch):
    build(town)
    monkeypatch.setattr(coarse_index, "_GROWTH", 1.5)
    add(town, 100, 40)
    assert build(town).new == 40
    add(town, 200, 40)
    assert build(town).new == 180
    assert len(CoarseIndex(town).sample["signs"]) == 180


def test_the_sample_is_of_the_rows_as_they_are_stored(town):
    build(town)
    sample, frames = CoarseIndex(town).sample, town.load()
    assert all(torch.equal(sample[name], values) for name, values in frames.channels.items())


def test_an_index_that_is_learnt_anew_has_no_codes_of_another(town):
    def folders():
        return [path for path in Path(town.path, "_coarse").iterdir() if path.is_dir()]

    build(town)
    [before] = folders()
    Path(town.path, "_coarse", "index.json").unlink()
    assert build(town).new == 100
    [after] = folders()
    assert after != before


def test_too_many_files_are_said_so(town, monkeypatch):
    build(town)

    def load(*_given, **_options):
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(np, "load", load)
    refuses(r"more files than this process may open \(ulimit -n\)", CoarseIndex, town)


def test_what_cannot_be_opened_or_built_is_refused_in_one_line(town, tmp_path):
    refuses("has no index; ssrvlad db index builds one", CoarseIndex, town)
    build(town)
    about = Path(town.path, "_coarse", "index.json")
    other = json.loads(about.read_text())
    other["columns"][1][1] = "many"
    about.write_text(json.dumps(other))
    refuses("is of other channels; ssrvlad db index builds it anew", CoarseIndex, town)
    assert build(town).new == 100
    refuses("holds no frames yet", build, Database.create(tmp_path / "empty", CONFIG))
    about.write_text("{")
    refuses("is damaged, or of another version; ssrvlad db index", CoarseIndex, town)
    assert build(town).new == 100
    codes = next(Path(town.path, "_coarse").glob("*/*.1.signs.npy"))
    codes.write_bytes(codes.read_bytes()[:-1])
    refuses("lacks 100 of 100 frames", CoarseIndex, town)
    assert build(town).new == 100
    assert_own_row_is_first(town, "a/0000", rows(0, 1))
    spoil(Path(town.path), rows(0, 3)["ssr-vlad"][2])
    add(town, 100, 1)
    assert build(Database.open(town.path)).new == 1, "what is indexed is not read again"
    about.unlink()
    refuses("is damaged", build, Database.open(town.path))


def test_every_file_of_the_index_is_checked_and_mended(town):
    build(town)
    assert damaged(town) == [] and build(town).new == 0
    arrays = "*.0.ssr-vlad.npy", "*.1.signs.npy", "*.sums.signs.npy"
    for name in (*arrays, "*.sums.npz", "*.checksums.json", "learnt.npz", "sample.npz"):
        for keep in (None, 20, 9):
            [file] = Path(town.path, "_coarse").glob(f"*/{name}")
            content = file.read_bytes()
            turned = content[:-20] + bytes(255 - each for each in content[-20:])
            file.write_bytes(content[:keep] if keep else turned)
            assert len(damaged(town)) == 1, name
            build(town)
            assert damaged(town) == [], name
    about = Path(town.path, "_coarse", "index.json")
    about.write_text(about.read_text().replace('"format": 4', '"format": 3'))
    assert damaged(town) == ["_coarse/index.json"]
    refuses("is damaged, or of another version; ssrvlad db index builds it anew", CoarseIndex, town)


def test_a_map_keeps_its_index_complete(tmp_path):
    town = Map.open(tmp_path / "drawn.ssrdb", labels_as=SPACE)
    town.add(write_maps(tmp_path / "monday", range(6)))
    assert not Path(town.path, "_coarse").exists(), "only db index makes one"
    build(town.database)
    town.add(write_maps(tmp_path / "tuesday", range(3)))
    CoarseIndex(town.database)  # is refused where it lacks frames
