"""The index of a large map: codes of all rows, grown, opened, refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import SPACE
from helpers import descriptors, refuses, spoil, write_maps
from large_maps import CONFIG

from ssrvlad_torch import Database, Map
from ssrvlad_torch.channels import Column
from ssrvlad_torch.search.index import Index, MapRows, build, damaged

SIGNS = Column("signs", "few", (4, 2, 4), "uint8")


def rows(first, count):
    """Descriptors by two channels."""
    signs = np.random.default_rng(first).integers(0, 256, (count, *SIGNS.shape), np.uint8)
    return {"ssr-vlad": descriptors(first, count), "signs": torch.from_numpy(signs)}


def add(database, first, count):
    database.append([f"a/{first + n:04d}" for n in range(count)], rows(first, count))


def opened(database):
    index = Index(database, MapRows.of(database))
    return index, index.codes()


@pytest.fixture
def town(tmp_path):
    """100 frames by two channels."""
    database = Database.create(tmp_path / "town.ssrdb", CONFIG, columns=[SIGNS])
    add(database, 0, 100)
    return database


def assert_own_row_is_first(database, frame, query):
    """That of all rows the one that equals a query has its highest score by every channel."""
    index, codes = opened(database)
    for name, values in query.items():
        [scores] = index.coders[name].scores(values[:1], codes[name], True)
        assert len(scores) == len(database)
        assert index.rows.frames.frames[int(scores.argmax())] == frame


def test_every_row_has_its_code_also_after_changes_of_the_map(town):
    report = build(town)
    assert (report.new, report.frames) == (100, 100) and report.bytes > 100 * 64
    assert_own_row_is_first(town, "a/0000", rows(0, 1))
    add(town, 100, 70)
    refuses("lacks 70 of 170 frames; ssrvlad db index adds them", opened, town)
    assert build(town).new == 70
    assert_own_row_is_first(town, "a/0100", rows(100, 1))
    town.remove(["a/0003", "a/0100"])
    assert build(town)[:2] == (0, 168)
    town.merge(["a/0000"], rows(500, 1))
    assert build(town).new == 1
    assert_own_row_is_first(town, "a/0000", rows(500, 1))
    town.compact(keep_days=0)
    assert build(town).new == 0
    assert_own_row_is_first(town, "a/0000", rows(500, 1))


def test_what_cannot_be_opened_or_built_is_refused_in_one_line(town, tmp_path):
    refuses("has no index; ssrvlad db index builds one", opened, town)
    refuses("holds no frames yet", build, Database.create(tmp_path / "empty", CONFIG))

    build(town)
    spoil(Path(town.path), rows(0, 3)["ssr-vlad"][2])
    add(town, 100, 1)
    assert build(Database.open(town.path)).new == 1, "what is indexed is not read again"
    Path(town.path, "_index", "learnt.npz").unlink()
    refuses("is damaged; ssrvlad db verify shows where", build, Database.open(town.path))


def test_an_index_of_other_channels_is_built_anew(town, tmp_path):
    build(town)
    other = Database.create(tmp_path / "other.ssrdb", CONFIG)
    other.append(["a/0"], descriptors(0, 1))
    Path(town.path, "_index").rename(Path(other.path, "_index"))
    refuses("of other channels or another version; ssrvlad db index builds", opened, other)
    assert build(other).new == 1


@pytest.mark.parametrize("name", ["codes/data/*.lance", "learnt.npz"])
@pytest.mark.parametrize("keep", [None, 20, 0])
def test_every_file_of_the_index_is_checked_and_mended(town, name, keep):
    build(town)
    assert damaged(town) == []
    [file] = Path(town.path, "_index").glob(name)
    content = file.read_bytes()
    middle = len(content) // 2
    turned = content[:middle] + bytes(255 - byte for byte in content[middle:][:64])
    file.write_bytes(content[:keep] if keep is not None else turned + content[middle + 64 :])
    assert damaged(town) == [f"_index/{name.split('/')[0]}"]
    build(town)
    assert damaged(town) == []
    assert_own_row_is_first(town, "a/0000", rows(0, 1))


def test_a_map_keeps_its_index_complete(tmp_path):
    town = Map.open(tmp_path / "drawn.ssrdb", labels_as=SPACE)
    town.add(write_maps(tmp_path / "monday", range(6)))
    assert not Path(town.path, "_index").exists(), "only db index makes one"
    build(town.database)
    town.add(write_maps(tmp_path / "tuesday", range(3)))
    opened(town.database)
