"""Encoding by Ray: the same rows as without it, whatever happens to its workers."""

import os

import pytest
import torch
from helpers import write_street
from ssrvlad_torch.database.storage.verification import verify

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.remote_files import find_remote_files
from ssrvlad_torch.encoding import encoder as encoding
from ssrvlad_torch.encoding import ray_engine
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.ray_engine import PartEncoder, encode_with_ray, write_rows

ray = pytest.importorskip("ray", reason="needs the extra ray")
pytest.importorskip("ray.data", reason="needs the extra ray")
pytestmark = pytest.mark.slow

CONFIG = SSRVLADConfig.from_preset("paper", labels_as="camvid-11")


@pytest.fixture(scope="module", autouse=True)
def cluster():
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)
    yield
    ray.shutdown()


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.setattr(encoding, "PART_ROWS", 8)
    for number in range(20):
        write_street(tmp_path / "a" / f"{number}.png", number)
    return find_label_files([str(tmp_path / "a")])


def same_as_local(path, files):
    """Whether a database holds what the local engine makes of the same files."""
    local = Database.create(path.with_name("local"), CONFIG)
    encode_to_database(SSRVLAD(CONFIG), files, local, workers=0)
    wanted, found = local.load(), Database.open(path).load()
    assert found.frames == wanted.frames
    assert torch.equal(found.descriptors, wanted.descriptors)
    assert {f: r.digest for f, r in Database.open(path).known().items()} == {
        f: r.digest for f, r in local.known().items()
    }
    assert verify(path) == []


def test_the_rows_are_those_of_the_local_engine(tmp_path, files):
    database = Database.create(tmp_path / "db", CONFIG)
    (tmp_path / "a" / "7.png").write_text("no image")
    summary = encode_with_ray(CONFIG, files, database)
    assert (summary.encoded, summary.already_there) == (19, 0)
    assert [refusal.frame for refusal in summary.refused] == ["a/7"]
    same_as_local(tmp_path / "db", files)
    write_street(tmp_path / "a" / "7.png", 7)
    write_street(tmp_path / "a" / "3.png", 99)
    summary = encode_with_ray(CONFIG, files, Database.open(tmp_path / "db"))
    assert (summary.encoded, summary.changed, summary.already_there) == (1, 1, 18)


def test_a_killed_worker_loses_nothing(tmp_path, files, monkeypatch):
    """It dies with a part in hand."""
    flag = tmp_path / "died"

    class Mortal(PartEncoder):
        def __call__(self, batch):
            if not flag.exists():
                flag.touch()
                os._exit(1)
            return super().__call__(batch)

    monkeypatch.setattr(ray_engine, "PartEncoder", Mortal)
    summary = encode_with_ray(CONFIG, files, Database.create(tmp_path / "db", CONFIG))
    assert flag.exists()
    assert summary.encoded == 20
    same_as_local(tmp_path / "db", files)


def test_a_retried_task_leaves_no_duplicates(tmp_path, files, monkeypatch):
    """It dies after it wrote its part."""
    flag, write = tmp_path / "died", write_rows

    def mortal(row, folder):
        written = write(row, folder)
        if not flag.exists():
            flag.touch()
            os._exit(1)
        return written

    monkeypatch.setattr(ray_engine, "write_rows", mortal)
    summary = encode_with_ray(CONFIG, files, Database.create(tmp_path / "db", CONFIG))
    assert flag.exists()
    assert summary.encoded == 20
    assert len(list((tmp_path / "db").glob("part-*"))) == 3
    same_as_local(tmp_path / "db", files)


def test_what_landed_before_an_interruption_stays(tmp_path, files, monkeypatch):
    whole = ray_engine._parts

    def interrupted(*arguments):
        for number, part in enumerate(whole(*arguments)):
            if number == 2:
                raise KeyboardInterrupt
            yield part

    with monkeypatch.context() as patch:
        patch.setattr(ray_engine, "_parts", interrupted)
        with pytest.raises(KeyboardInterrupt):
            encode_with_ray(CONFIG, files, Database.create(tmp_path / "db", CONFIG))
    landed = len(Database.open(tmp_path / "db"))
    assert landed in (12, 16), "two of the parts of 8, 8 and 4"
    told = []
    summary = encode_with_ray(CONFIG, files, Database.open(tmp_path / "db"), progress=told.append)
    assert (summary.encoded, summary.already_there, sum(told)) == (20 - landed, landed, 20)
    same_as_local(tmp_path / "db", files)


def test_a_task_that_fails_is_one_line_and_the_database_is_valid(tmp_path, files, monkeypatch):
    class Failing(PartEncoder):
        def __call__(self, batch):
            raise ZeroDivisionError

    def elsewhere(row, folder):
        return write_rows(row, folder / "not there")

    for name, stand_in, message in (
        ("PartEncoder", Failing, "Ray gave up: "),
        ("write_rows", elsewhere, "No such file or directory"),
    ):
        database = Database.open_or_create(tmp_path / "db", CONFIG)
        with monkeypatch.context() as patch, pytest.raises(OSError, match=message) as failure:
            patch.setattr(ray_engine, name, stand_in)
            encode_with_ray(CONFIG, files, database)
        assert "\n" not in str(failure.value)
    assert len(Database.open(tmp_path / "db")) == 0
    assert verify(tmp_path / "db") == []


def test_files_that_only_pyarrow_reaches_give_the_same_rows(tmp_path, files):
    remote = find_remote_files([(tmp_path / "a").as_uri()])
    summary = encode_with_ray(CONFIG, remote, Database.create(tmp_path / "db", CONFIG))
    assert (summary.encoded, summary.refused) == (20, [])
    same_as_local(tmp_path / "db", files)


def test_frames_whose_file_is_gone_are_removed_if_asked(tmp_path, files):
    database = Database.create(tmp_path / "db", CONFIG)
    encode_with_ray(CONFIG, files, database)
    kept = [file for file in files if file.name != "7"]
    assert encode_with_ray(CONFIG, kept, database, complete=True).gone == ["a/7"]
    assert encode_with_ray(CONFIG, kept, database, complete=True, prune=True).pruned == 1
    same_as_local(tmp_path / "db", kept)
