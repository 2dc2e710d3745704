"""Ways to search: the same candidates from memory, from the disk and, mostly, from an index."""

import numpy as np
import pytest
import torch
from helpers import descriptors, record

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.database import searching
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.searching import Ivfpq, load_mapped
from ssrvlad_torch.recognition.matching import match

CONFIG = SSRVLADConfig.from_preset("paper", rings=1, sectors=2, labels_as="camvid-11")


def filled(path, count, seed=0, into=None):
    database = into or Database.create(path, CONFIG)
    numbers = descriptors(seed, count, CONFIG.length)
    numbers[:: max(3, count // 4)] = 0
    database.append([record(f"{seed}/{n}") for n in range(count)], numbers)
    return database


@pytest.mark.parametrize("temporal", [0, 2])
def test_mapped_frames_are_those_in_memory(tmp_path, temporal):
    database = filled(tmp_path / "db", 40)
    mapped, loaded = load_mapped(database, temporal), database.load(temporal)
    assert mapped.frames == loaded.frames
    assert mapped.sequences == loaded.sequences
    assert torch.equal(mapped.descriptors, loaded.descriptors)
    np.testing.assert_array_equal(mapped.poses, loaded.poses)
    np.testing.assert_array_equal(mapped.empty, loaded.empty)
    half = load_mapped(database, temporal, "float16")
    assert torch.equal(half.descriptors, loaded.descriptors.half())


def test_half_precision_leaves_half_the_bytes(tmp_path):
    """The single matrix that it is made from goes, unless it was there."""
    database = filled(tmp_path / "db", 40)
    load_mapped(database, precision="float16")
    assert [file.name.split("-")[-1] for file in database.path.glob("search-*")] == ["float16.npy"]
    load_mapped(database)
    load_mapped(database, 2, "float16")
    assert len(list(database.path.glob("search-*-t0-float32.npy"))) == 1


def test_a_changed_database_is_mapped_anew_and_the_old_matrix_goes(tmp_path, monkeypatch):
    database = filled(tmp_path / "db", 10)
    load_mapped(database)
    [old] = database.path.glob("search-*")
    with monkeypatch.context() as patch:
        patch.setattr(searching, "_write_matrix", None)
        load_mapped(Database.open(database.path))
    filled(None, 5, seed=1, into=database)
    assert len(load_mapped(database).frames) == 15
    filled(None, 5, seed=2, into=database)
    assert not old.exists()


def test_half_precision_changes_scores_little(tmp_path):
    database = filled(tmp_path / "db", 200)
    queries = descriptors(9, 20, CONFIG.length)
    exact = match(queries, database.load().descriptors, 3)
    half = match(queries, load_mapped(database, precision="float16").descriptors, 3)
    torch.testing.assert_close(half.scores, exact.scores, rtol=0, atol=1e-3)


@pytest.fixture(scope="module")
def clustered(tmp_path_factory):
    """Twelve thousand descriptors around four hundred places."""
    pytest.importorskip("faiss", reason="needs the extra search")
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(400, CONFIG.length, generator=generator).repeat(30, 1)
    numbers = places + 0.3 * torch.randn(places.shape, generator=generator)
    database = Database.create(tmp_path_factory.mktemp("search") / "db", CONFIG)
    records = [record(f"{n % 2}/{n}") for n in range(len(numbers))]
    database.append(records, torch.nn.functional.normalize(numbers, dim=1))
    return database


def test_an_index_finds_most_of_the_best_with_their_exact_scores(clustered):
    references = load_mapped(clustered)
    index = Ivfpq.of(clustered, references.descriptors, 0)
    assert index.report.recall_at[1] > 0.8
    assert index.report.recall_at[10] > 0.8
    assert index.report.bytes < references.descriptors.numel() * 4
    queries = references.descriptors[5:2000:100]
    exact, found = match(queries, references.descriptors, 5), index.match(queries, 5)
    assert (found.indices[:, 0] == exact.indices[:, 0]).all()
    same = found.indices == exact.indices
    torch.testing.assert_close(found.scores[same], exact.scores[same])
    again = Ivfpq.of(clustered, references.descriptors, 0)
    assert again.report is None, "it is built once"
    assert torch.equal(again.match(queries, 5).indices, found.indices)


def test_an_index_keeps_to_the_limits(clustered):
    references = load_mapped(clustered)
    index = Ivfpq.of(clustered, references.descriptors, 0)
    where = np.array([sequence == "1" for sequence in references.sequences])
    rows = np.array([7000, 9000])
    ranges = np.stack([rows - 2, rows + 3], axis=1)
    queries = references.descriptors[rows]
    found = index.match(queries, 5, 0.1, where, ranges).indices
    assert (found >= 0).any()
    for row, limits in zip(found, ranges, strict=True):
        for candidate in row[row >= 0].tolist():
            assert where[candidate]
            assert not limits[0] <= candidate < limits[1]


def test_too_few_references_are_refused(tmp_path):
    pytest.importorskip("faiss", reason="needs the extra search")
    database = filled(tmp_path / "db", 100)
    with pytest.raises(ValueError, match="wants at least 9984 references to learn from, got 100"):
        Ivfpq.of(database, database.load().descriptors, 0)
    assert not list(database.path.glob("*ivfpq*"))


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "faiss", None)
    database = filled(tmp_path / "db", 3)
    with pytest.raises(ImportError, match=r"pip install ssrvlad-torch\[search\]"):
        Ivfpq.of(database, database.load().descriptors, 0)
