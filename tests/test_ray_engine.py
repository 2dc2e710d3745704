"""Encoding with Ray gives the same rows as without it, also if workers fail."""

import os
import sys

import pytest
import torch
from helpers import write_street as write_map

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding import ray_engine
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.ray_engine import ChunkEncoder, encode_with_ray
from ssrvlad_torch.encoding.results import EncodeOptions

pytestmark = pytest.mark.slow

HEAD = SSRVLAD.from_preset("paper", labels_as="camvid-11")
TWO = EncodeOptions(workers=2)


@pytest.fixture(scope="module", autouse=True)
def cluster():
    pytest.importorskip("ray.data", reason="needs the extra ray")
    ray = sys.modules["ray"]
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)
    yield
    ray.shutdown()


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.setattr(ray_engine, "CHUNK_FRAMES", 8)
    for number in range(20):
        write_map(tmp_path / "a" / f"{number}.png", number)
    return find_label_files([str(tmp_path / "a")])


@pytest.fixture
def database(tmp_path):
    return Database.create(tmp_path / "db", HEAD.config)


def assert_same_as_local(path, files):
    """Asserts that a database holds the rows that the local engine makes of the same files."""
    local = Database.create(path.with_name("local"), HEAD.config)
    encode_to_database(HEAD, files, local, EncodeOptions(workers=0))
    expected, stored = local.load(), Database.open(path).load()
    assert stored.frames == expected.frames
    assert torch.equal(stored.descriptors, expected.descriptors)
    records = sorted(Database.open(path).known().values())
    assert repr(records) == repr(sorted(local.known().values()))


def test_the_rows_are_those_of_the_local_engine(tmp_path, files, database):
    (tmp_path / "a" / "7.png").write_text("no image")
    counted = []
    options = EncodeOptions(workers=2, progress=counted.append)
    summary = encode_with_ray(HEAD, files, database, options)
    assert (summary.encoded, summary.already_there, sum(counted)) == (19, 0, 20)
    assert [frame.frame for frame in summary.skipped] == ["a/7"]
    assert_same_as_local(tmp_path / "db", files)
    write_map(tmp_path / "a" / "7.png", 7)
    write_map(tmp_path / "a" / "3.png", 99)
    others = [file for file in files if file.name != "9"]
    options = EncodeOptions(workers=2, complete=True, prune=True)
    summary = encode_with_ray(HEAD, others, Database.open(tmp_path / "db"), options)
    assert (summary.encoded, summary.anew, summary.already_there) == (1, {"file changed": 1}, 17)
    assert summary.pruned == 1


def test_a_killed_worker_loses_nothing(tmp_path, monkeypatch, files, database):
    """It dies after it made its chunk, which is made again and added once."""
    flag = tmp_path / "died"

    class Mortal(ChunkEncoder):
        def __call__(self, files):
            chunk = super().__call__(files)
            if not flag.exists():
                flag.touch()
                os._exit(1)
            return chunk

    monkeypatch.setattr(ray_engine, "ChunkEncoder", Mortal)
    assert encode_with_ray(HEAD, files, database, TWO).encoded == 20
    assert flag.exists()
    assert_same_as_local(tmp_path / "db", files)


def test_ray_that_does_not_start_is_an_error_in_one_line(files, database, monkeypatch):
    def fail(**settings):
        raise RuntimeError("no room in\n/dev/shm")

    ray = sys.modules["ray"]
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", fail)
    with pytest.raises(OSError, match=r"^Ray does not start: no room in /dev/shm$"):
        encode_with_ray(HEAD, files, database, TWO)
