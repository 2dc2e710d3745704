"""A database in an object store, tried against a local server that speaks S3."""

import pytest
import torch
from helpers import descriptors, refused

from ssrvlad_torch import Database
from ssrvlad_torch.database import engine


def test_a_database_lives_in_a_bucket(bucket):
    uri = f"{bucket}/morning.ssrdb"
    assert not Database.exists(uri)
    database, numbers = Database.create(uri, width=8), descriptors(0, 3, 8)
    database.append(["a/1", "a/2", "a/3"], numbers)
    database.merge(["a/1"], torch.zeros(1, 8))
    database.remove(["a/2"])
    with pytest.raises(ValueError, match=r"frame 'a/1' is in s3://town/morning\.ssrdb already"):
        database.append(["a/1"], numbers[:1])
    opened = Database.open(uri)
    assert Database.exists(uri)
    assert opened.damage() == []
    assert opened.load().frames == ("a/1", "a/3")
    assert torch.equal(opened.load().descriptors[1], numbers[2])
    assert [entry.frames for entry in opened.history()] == [0, 3, 3, 2]
    opened.compact(keep_days=0)
    assert len(Database.open(uri)) == 2


def test_what_is_not_in_the_store_is_one_line_after_one_attempt(bucket, monkeypatch):
    uri, open_dataset, attempts = f"{bucket}/morning.ssrdb", engine.lance().dataset, []
    database = Database.create(uri, width=8)
    with refused(rf"^{uri} has no version 99; it has {database.version}$"):
        Database.open(uri, version=99)

    def counted(uri, **options):
        attempts.append(uri)
        return open_dataset(uri, **options)

    monkeypatch.setattr(engine.lance(), "dataset", counted)
    missing = [f"{bucket}/evening.ssrdb", "s3://village/morning.ssrdb"]
    for one in missing:
        assert not Database.exists(one)
    assert attempts == missing
    for one in missing:
        with refused(f"^{one} does not exist, or is damaged or not a database: .*[nN]ot [fF]ound"):
            Database.open(one)
    assert attempts == 2 * missing
    with refused(f"^{missing[0]} does not exist, or"):
        Database.open(missing[0], version=1)
    with refused("^s3://village/new cannot be written: [^<]*404 Not Found$", by=OSError):
        Database.create("s3://village/new", width=8)
